"""The paper's claims about Figure 2, tested by sweeps, branches and closed forms."""

import numpy as np

from .claims import CONFIRMED, CONTRADICTED, PARTLY, Claim
from .discrepancy import shares
from .response import WALL, Response


def check_figure_2(found: Response, panels: list[dict]) -> list[Claim]:
    """Measure each claim about the whole of Figure 2.

    **Arguments:** the computed response of the figure; its panels as returned by `describe`.
    """
    return [_free(found), _everywhere(panels), _reason(panels), _wall(panels)]


def _sweeps(panels: list[dict]) -> dict[str, dict]:
    """Return the sweeps of all panels, by their panel and direction in words."""
    return {
        f"k = {panel['restitution']:g}, {'' if panel['damping_ratio'] else 'un'}damped, {name}": at
        for panel in panels
        for name, at in panel["sweeps"].items()
    }


def _free(found: Response) -> Claim:
    numbers, seen = {}, 0
    for system in found.systems:
        if not system.damping_ratio:
            continue  # undamped the free vibration never dies out
        free = 1 / np.abs(1 - found.ratios**2 + 2j * system.damping_ratio * found.ratios)
        for name, at in system.sweeps.items():
            quiet = np.asarray(at.impacts) == 0
            off = np.abs(np.stack([at.y_max - free, at.y_min + free]))[:, quiet]
            numbers[f"k = {system.restitution:g}, {name}"] = float(off.max())
            seen += int(quiet.sum())
    undamped = 1 / np.abs(1 - np.array([0.6, 1.4]) ** 2)
    worst = max(numbers.values())
    return Claim(
        "free analytic response",
        "Eq. 15, Fig. 2",
        "Where nothing is struck the amplitude is A = a/(1 - ζ²).",
        f"With Table 1's damping {seen} swept values strike nothing; their extremes are off "
        f"±1/|1 - ζ² + 2iξζ| by at most {worst:.0e}. The printed A leaves ξ out (A/a = "
        f"{undamped[0]:.3f} at ζ = 0.6, {undamped[1]:.3f} at 1.4); undamped, what a start leaves "
        "of the free vibration never dies out, and simulations scatter about it.",
        CONFIRMED if worst < 1e-6 else CONTRADICTED,
        {"largest_difference_damped": numbers},
    )


def _everywhere(panels: list[dict]) -> Claim:
    apart = {name: (at["apart"], at["values"]) for name, at in _sweeps(panels).items()}
    some, all_ = (sum(x[i] for x in apart.values()) for i in (0, 1))
    lines = "; ".join(
        f"k = {panel['restitution']:g}, ξ = {panel['damping_ratio']:.3f}: "
        f"{panel['BB']:.5f} to {panel['CC']:.5f}"
        for panel in panels
    )
    return Claim(
        "the minimum is discrepant between BB' and CC'",
        "Results, on Fig. 2",
        "A discrepancy of the minimum occurs in the region between BB' and CC'.",
        f"At {some} of {all_} swept values between the two lines the minimum is more than 0.001 a "
        f"from the 2π analysis. The lines, not given in numbers, are its birth and its period "
        f"doubling: {lines}.",
        CONFIRMED if some == all_ else PARTLY,
        {"apart_and_values": apart},
    )


def _reason(panels: list[dict]) -> Claim:
    numbers, described = {}, []
    for name, at in _sweeps(panels).items():
        one, four = shares(at)
        numbers[name] = {"4pi_one_impact": one, "any_4pi": four}
        described.append(f"{name} {one:.0%} and {four:.0%}")
    return Claim(
        "the reason is a motion of period 4π",
        "Results, conclusion",
        "Between BB' and CC' the numerical solution has the period 4π of the second analysis.",
        "Parts of the stretch on the 4π motion with one impact, which that analysis is about, and "
        f"on any of period 4π: {'; '.join(described)}. The rest has other periods or none.",
        PARTLY if any(x["4pi_one_impact"] for x in numbers.values()) else CONTRADICTED,
        numbers,
    )


def _wall(panels: list[dict]) -> Claim:
    numbers = {
        name: {
            "values": at["values"],
            "analysis_clear": at["analysis_clear_of_the_wall"],
            "sweep_reaches": at["sweep_reaches_the_wall"],
        }
        for name, at in _sweeps(panels).items()
    }
    described = "; ".join(
        f"{name} {x['sweep_reaches']} of {x['values']}" for name, x in numbers.items()
    )
    clear = all(x["analysis_clear"] == x["values"] for x in numbers.values())
    reach = [x["sweep_reaches"] for x in numbers.values()]
    return Claim(
        "a wall on the lower side would be struck",
        "Results, on Fig. 2",
        "The 2π analysis stays away from a further wall below, which the numerical motion reaches.",
        f"The wall's place is not given; it is taken as Y = {WALL:g}. The 2π analysis is clear of "
        f"it {'everywhere' if clear else 'not everywhere'} between BB' and CC'; swept motions "
        f"reach it at: {described}.",
        (CONFIRMED if all(reach) else PARTLY) if clear and any(reach) else CONTRADICTED,
        {"wall": WALL, "sweeps": numbers},
    )
