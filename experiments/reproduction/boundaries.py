"""The boundaries of the paper's discrepancy in the planes (ζ, k) and (ζ, c)."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.interpolate import CubicSpline
from tools.ideal import births
from tools.pictures import legend_below, panels
from vi_jax.machines import Parameters, Scene
from vi_jax.orbit import Boundary, Branch, boundary, closed_form_orbits, continue_orbit, find_orbit
from vi_jax.plot import DASHES, color_of, paler

from .motions import FREQUENCY_RATIO, RESTITUTION, table_damping_ratio
from .response import BOUNCE as K
from .response import DAMPING as XI
from .response import MAX_STEP, RANGE, RATIO

# At k = 1 without damping the motions are no longer isolated, and the curves end there.
K_RANGE, C_RANGE = (0.02, 0.999), (0.0, 1.2)

SHORT, SHORT_FILL = color_of(1, 1), paler(color_of(1, 1), 0.2)
LONG_FILL = paler(color_of(2, 1), 0.4)
# Darker than the filling, to be visible on it.
LONG = "#b87f00"

# Beginning of a curve's name, colour, kind and label of the lines in both planes.
LINES = (
    ("birth", SHORT, "grazing", "2π: born by grazing"),
    ("doubling", SHORT, "period-doubling", "2π: period doubling"),
    ("fold", SHORT, "fold", "2π: fold"),
    ("touch", LONG, "grazing", "4π: touches the stop again"),
    ("long_doubling", LONG, "period-doubling", "4π: period doubling"),
)

# The curves in the planes (ζ, k), undamped, and (ζ, ξ), with k = 0.5; d = 2 in both. The 2π motion
# has one impact per drive cycle, the 4π motion has one in two cycles. The start of each curve:
# period in cycles and k of a branch, the kind of its point, and the second parameter. At k = 0.5
# the 4π motion is stable in its whole range, at k = 0.8 it is not.
CURVES: dict[str, tuple[int, float, str, str]] = {
    # The 2π motion is unstable on the side of smaller ζ.
    "doubling_k": (1, RESTITUTION, "period-doubling", K),
    # The 4π motion touches the stop a second time; it exists between the curve's two arms. This is
    # the family of the figures' motion. At higher damping there is another family near the birth.
    "touch_k": (2, RESTITUTION, "grazing", K),
    "doubling_c": (1, RESTITUTION, "period-doubling", XI),
    "touch_c": (2, RESTITUTION, "grazing", XI),
    # The 2π motion appears. Without damping it does so at ζ = √(1 - 1/d) for every k, because an
    # impact of zero speed has no effect.
    "birth_c": (1, RESTITUTION, "grazing", XI),
    # The 2π motion ends towards large ζ.
    "fold_k": (1, RESTITUTION, "fold", K),
    "fold_c": (1, RESTITUTION, "fold", XI),
    # The 4π motion is unstable between the curve's two arms.
    "long_doubling_k": (2, 0.8, "period-doubling", K),
}
Curves = Mapping[str, Boundary]
"""Curves by the names of `CURVES`."""


# c of Table 1, in N·s/m.
TABLE_DAMPING = float(Parameters().damping)


def xi_per_c() -> float:
    """Return ξ of c = 1 N·s/m in the machine of Table 1."""
    return table_damping_ratio() / TABLE_DAMPING


def follow_curves(names: Sequence[str], branches: Sequence[Branch] = ()) -> dict[str, Boundary]:
    """Follow the named curves of `CURVES`. They begin on `branches` in ζ; a missing branch is
    followed first."""
    begins = dict.fromkeys(CURVES[name][:2] for name in names)
    known = {(cycles, k): _branch(cycles, k, branches) for cycles, k in begins}

    def follow(name: str) -> Boundary:
        cycles, k, kind, parameter = CURVES[name]
        special = (p for p in known[cycles, k].special if p.kind == kind)
        point = min(special, key=lambda p: p.parameter)
        other = K_RANGE if parameter == K else (0.0, C_RANGE[1] * xi_per_c())
        return boundary(point, parameter=parameter, bounds=(RANGE, other), max_step=0.03)

    # Most of the time is compilation, in which two threads are faster than one.
    with ThreadPoolExecutor(2) as threads:
        return dict(zip(names, threads.map(follow, names), strict=True))


def _branch(cycles: int, k: float, known: Sequence[Branch]) -> Branch:
    """Return the undamped branch in ζ with one impact in `cycles` cycles, a known or a new one."""
    for branch in known:
        scene = branch.problem.machine
        if (
            (branch.name, branch.cycles, branch.impact_speed.shape[1]) == (RATIO, cycles, 1)
            and isinstance(scene, Scene)
            and float(scene.stops[0].restitution) == k
            and float(scene.damping_ratio) == 0.0
        ):
            return branch
    scene = Scene.ideal(frequency_ratio=FREQUENCY_RATIO, restitution=k)
    closed = closed_form_orbits(scene, cycles=cycles)
    start = scene.start(Y=closed.Y[0], V=closed.V[0])
    orbit = find_orbit(scene, start, cycles=cycles, throw=True)
    return continue_orbit(orbit, parameter=RATIO, bounds=RANGE, max_step=MAX_STEP)


def plane_points(curve: Boundary) -> np.ndarray:
    """Return points (ζ, k) or (ζ, c) of a curve, with c in N·s/m."""
    points = curve.parameters.copy()
    if curve.names[1] == XI:
        points[:, 1] /= xi_per_c()
    return points


def _crossing(curve: Boundary, column: int, value: float, place: int) -> float | None:
    """Return the other coordinate of a curve's first (0) or last (-1) point with a value of ζ
    (column 0) or of k or c (column 1), `None` if it does not reach the value. Splines interpolate
    the points; their error is below 1e-5."""
    spline = _spline(curve)
    here = CubicSpline(spline.x, plane_points(curve)[:, column])
    found = sorted(spline(here.solve(value, extrapolate=False))[:, 1 - column].tolist())
    return found[place] if found else None


def _spline(curve: Boundary) -> CubicSpline:
    points = plane_points(curve)
    scaled = points / np.ptp(points, axis=0).clip(1e-9)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(scaled, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(length) > 1e-9])
    return CubicSpline(length[keep], points[keep])


def _turn(curve: Boundary, sign: int) -> list[float]:
    """Return (ζ, k) or (ζ, c) of a curve at its least (-1) or greatest (1) k or c."""
    spline = _spline(curve)
    fine = spline(np.linspace(spline.x[0], spline.x[-1], 20_001))
    return fine[np.argmax(sign * fine[:, 1])].tolist()


def _birth_without_damping(curves: Curves) -> float:
    """Return ζ of the grazing at which the 2π motion appears, the same for every k."""
    points = plane_points(curves["birth_c"])
    return float(points[np.argmin(points[:, 1]), 0])


def describe_boundaries(curves: Curves) -> dict[str, float | None]:
    """Return numbers of the curves at the figures' ζ and k, and at Table 1's c; `None` if the curve
    does not reach this value, as the 4π curve at Table 1's c."""

    def at(curve: str, column: int, value: float, place: int = 0) -> float | None:
        return _crossing(curves[curve], column, value, place)

    zeta, k, c = FREQUENCY_RATIO, RESTITUTION, TABLE_DAMPING
    top, bottom = _turn(curves["touch_c"], 1), _turn(curves["touch_k"], -1)
    return {
        "birth, undamped, ζ": _birth_without_damping(curves),
        "doubling at k = 0.5, undamped, ζ": at("doubling_k", 1, k),
        "doubling at k = 0.8, undamped, ζ": at("doubling_k", 1, 0.8),
        "4π motion at k = 0.5, undamped, from ζ": at("touch_k", 1, k),
        "4π motion at k = 0.5, undamped, to ζ": at("touch_k", 1, k, -1),
        "4π motion, undamped, from k": bottom[1],
        "4π motion, undamped, from k, at ζ": bottom[0],
        "fold at k = 0.5, undamped, ζ": at("fold_k", 1, k),
        "fold at k = 0.8, undamped, ζ": at("fold_k", 1, 0.8),
        "doubling at ζ = 0.9, k = 0.5, c": at("doubling_c", 0, zeta),
        "4π motion at ζ = 0.9, k = 0.5, up to c": at("touch_c", 0, zeta, -1),
        "4π motion at k = 0.5, up to c": top[1],
        "4π motion at k = 0.5, up to c, at ζ": top[0],
        "birth at Table 1's c, k = 0.5, ζ": at("birth_c", 1, c),
        "doubling at Table 1's c, k = 0.5, ζ": at("doubling_c", 1, c),
        "4π motion at Table 1's c, k = 0.5, from ζ": at("touch_c", 1, c),
        "fold at Table 1's c, k = 0.5, ζ": at("fold_c", 1, c),
    }


def draw_boundaries(curves: Curves) -> Figure:
    """Draw (ζ, k) above (ζ, c): the whole plane, and the region of the discrepancy."""
    figure, grid = panels(12.5, 9.6, 2, 2, w_pad=0.08, width_ratios=(1.0, 1.25))
    for row, plane in zip(grid, "kc", strict=True):
        for ax, zoom in zip(row, (False, True), strict=True):
            _draw(ax, curves, plane, zoom)
    line = partial(Line2D, [], [])
    marks = (("*", 11, "Figs. 3 and 4: k = 0.5, ζ = 0.9"), ("P", 9, "the same with Table 1's c"))
    handles = [
        Patch(color=SHORT_FILL, label="2π motion unstable"),
        Patch(color=LONG_FILL, label="4π with one impact, the paper's family"),
        *(line(color=color, lw=1.8, ls=DASHES[kind], label=x) for _, color, kind, x in LINES),
        *(line(color="k", marker=x, ls="none", ms=size, label=label) for x, size, label in marks),
    ]
    legend_below(figure, handles, 3, fontsize=10)
    figure.suptitle(
        "Where the 2π motion is unstable and the paper's 4π motion exists (ideal, Δ = 2a)"
    )
    return figure


def _draw(ax: Axes, curves: Curves, plane: str, zoom: bool) -> None:
    in_k = plane == "k"
    low, high = K_RANGE if in_k else C_RANGE
    levels = np.linspace(low, high, 400)
    names = {name: f"{name}_{plane}" for name, *_ in LINES}
    parts = {name: [plane_points(curves[x])] for name, x in names.items() if x in curves}
    if in_k:
        parts["birth"] = [np.array([[_birth_without_damping(curves), y] for y in (low, high)])]
    # Birth and doubling are functions ζ(k) and ζ(c).
    left, right = (_over(parts[name][0], levels) for name in ("birth", "doubling"))
    ax.fill_betweenx(levels, left, right, color=SHORT_FILL, lw=0, zorder=0)
    ax.fill(*parts["touch"][0].T, color=LONG_FILL, lw=0, zorder=1)
    parts["birth"].append(np.column_stack([births(xi_per_c() * levels * (not in_k))[1], levels]))
    for name, color, kind, _ in LINES:
        for points in parts.get(name, ()):
            ax.plot(*points.T, color=color, lw=1.8, ls=DASHES[kind])
    ax.plot(FREQUENCY_RATIO, RESTITUTION if in_k else 0.0, "k*", ms=11, clip_on=False, zorder=6)
    if not in_k:
        ax.axhline(TABLE_DAMPING, color="k", lw=1.0, ls=":")
        ax.plot(FREQUENCY_RATIO, TABLE_DAMPING, "kP", ms=9, zorder=6)
        if not zoom:
            place = {"transform": ax.get_yaxis_transform(), "ha": "right", "va": "bottom"}
            ax.text(0.99, TABLE_DAMPING, "c of Table 1", fontsize=10, **place)
    ax.set(xlim=(0.68, 1.02) if zoom else RANGE, ylim=(low, 1.0 if in_k else high))
    ax.set(xlabel="frequency ratio ζ", ylabel="restitution k" if in_k else "damping c (N·s/m)")
    described = "without damping" if in_k else f"k = {RESTITUTION:g}"
    ax.set_title(f"{described}, enlarged" if zoom else described, fontsize=11)
    ax.grid(alpha=0.25, lw=0.5)


def _over(points: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return ζ of a curve at values of its other coordinate."""
    order = np.argsort(points[:, 1])
    return np.interp(levels, points[order, 1], points[order, 0])
