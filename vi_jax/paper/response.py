"""Figure 2: smallest and largest Y over ζ, by closed form, by continuation and by sweeps."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..flow import jit
from ..orbit import (
    Branch,
    ClosedFormOrbits,
    CycleMap,
    Orbit,
    closed_form_orbits,
    continue_orbit,
    cycle_map,
    find_orbit,
)
from ..plot import plot_branch, plot_sweep, save_picture
from ..plot.motion import BLUE, GREEN, PINK, RED
from ..scan import Sweep, sweep
from ..scene import RigidStop, Scene
from ..scene.leaves import with_leaf

RANGE = (0.5, 1.9)
GAP = 2.0
# The paper draws "a potential position" of a left wall and gives no number. This one lies below
# the 2π motion and above the 4π motion wherever both exist between BB' and CC'.
WALL = 2.5
RATIO = "drive.frequency_ratio"

# A region where the sweeps change much is stepped through more finely.
_FINE = (0.69, 1.02)
# Periods longer than this many cycles are not looked for: they are called irregular.
_LONGEST = 16
# Mean growth of a small disturbance per cycle, beyond which a motion counts as chaotic.
_CHAOS = 0.01


class Settled(NamedTuple):
    """What one sweep is on at each ζ, in the order of rising ζ."""

    sweep: Sweep
    """Observed after the sweep went on for thousands of cycles at each value."""
    exponent: np.ndarray
    """Largest Lyapunov exponent, per drive cycle."""


class Response(NamedTuple):
    """Everything in one panel of Figure 2."""

    restitution: float
    damping_ratio: float
    ratios: np.ndarray
    """ζ, rising."""
    closed: dict[int, ClosedFormOrbits]
    """Motions with one impact per 1 and per 2 drive cycles at each ζ (2π and 4π)."""
    branches: list[Branch]
    """The 2π branch first, then what springs from its period doubling, grazing by grazing."""
    stretch: tuple[float, float]
    """ζ of BB' and CC': birth and period doubling of the 2π impact motion."""
    up: Settled
    down: Settled
    walled: tuple[Settled, Settled] | None
    """Run-up and close-down through `_FINE` with a left stop at Y = -WALL (undamped only)."""

    @property
    def inside(self) -> np.ndarray:
        """Which ζ lie between BB' and CC'."""
        return (self.ratios >= self.stretch[0]) & (self.ratios <= self.stretch[1])


class Row(NamedTuple):
    """One motion that a sweep keeps to over an interval of ζ."""

    direction: str
    low: float
    high: float
    values: int
    """How many values of ζ the sweep has there."""
    cycles: int
    """Period in drive cycles; 0 for a motion that does not repeat."""
    impacts: float
    """Impacts in a period; in a cycle, on average, where there is no period."""
    exponent: float
    """Median of the largest Lyapunov exponent, per drive cycle."""
    confirmed: int
    """At how many of the values `find_orbit` gives this very motion, and it is stable."""
    deviation: float
    """Largest |min Y - min Y of the closed form| (unit: a); NaN where there is no closed form."""
    from_short: float
    """Largest |min Y - min Y of the 2π closed form| (unit: a)."""

    @property
    def motion(self) -> str:
        return motion_name(self.cycles, self.impacts, self.exponent)


def motion_name(cycles: int, impacts: float, exponent: float) -> str:
    """In words: period and impacts."""
    if not cycles:
        kind = "chaotic" if exponent > _CHAOS else "no short period"
        return f"{kind}, {impacts:.2f} impacts per 2π"
    count = round(impacts)
    return f"{2 * cycles}π, {count} impact{'' if count == 1 else 's'}"


def response(restitution: float, damping_ratio: float, quick: bool = False) -> Response:
    """Closed forms, continued branches and both sweeps for one k and ξ, with d = 2.

    **Arguments:** k; ξ; `quick` for coarser sweeps that settle for a shorter time.
    """
    step, fine, settle, long = (0.02, 0.01, 100, 400) if quick else (0.005, 0.002, 250, 4000)
    scene = Scene.ideal(frequency_ratio=0.9, restitution=restitution, damping_ratio=damping_ratio)
    low, high = RANGE
    ratios = np.concatenate(
        [
            np.arange(low, _FINE[0] - step / 2, step),
            np.arange(_FINE[0], _FINE[1] - fine / 2, fine),
            np.arange(_FINE[1], high + step / 2, step),
        ]
    )
    closed = {n: _closed(scene, ratios, n) for n in (1, 2)}
    branches = _branches(scene)
    first = branches[0]
    born = min(p.parameter for p in first.special if p.kind == "grazing")
    doubling = max(p.parameter for p in first.special if p.kind == "period-doubling")
    starts = _stack([_steady(scene, low), _steady(scene, high)])
    up, down = _both(scene, ratios, starts, settle, long)
    walled = None
    if not damping_ratio:
        k = float(scene.stops[0].restitution)
        fenced = eqx.tree_at(
            lambda s: s.stops,
            scene,
            (*scene.stops, RigidStop(WALL, k, side="left")),
            is_leaf=lambda x: isinstance(x, tuple),
        )
        part = (ratios >= _FINE[0]) & (ratios <= _FINE[1])
        last = np.flatnonzero(part)[-1]
        above = scene.start(Y=closed[1].Y[last, 0], V=closed[1].V[last, 0])
        starts = _stack([_steady(scene, ratios[part][0]), above])
        walled = _both(fenced, ratios[part], starts, settle, long)
    return Response(
        restitution, damping_ratio, ratios, closed, branches, (born, doubling), up, down, walled
    )


def _stack(states: Sequence[Any]) -> Any:
    return jtu.tree_map(lambda *x: jnp.stack([jnp.asarray(a, float) for a in x]), *states)


def _steady(scene: Scene, ratio: float) -> Any:
    """The motion without impacts, on the section: undamped, a start at rest would never forget."""
    gain = 1 / (1 - ratio**2 + 2j * float(scene.damping_ratio) * ratio)
    return scene.start(Y=gain.real, V=(1j * ratio * gain).real)


@partial(jit, static_argnames="cycles")
def _closed_forms(scene: Scene, ratios: jax.Array, cycles: int) -> ClosedFormOrbits:
    return jax.vmap(lambda z: closed_form_orbits(with_leaf(scene, RATIO, z), cycles=cycles))(ratios)


def _closed(scene: Scene, ratios: np.ndarray, cycles: int) -> ClosedFormOrbits:
    return jtu.tree_map(np.asarray, _closed_forms(scene, jnp.asarray(ratios), cycles))


def _branches(scene: Scene) -> list[Branch]:
    """The 2π branch; from its period doubling on, what lies beyond each grazing."""
    above = with_leaf(scene, RATIO, jnp.asarray(1.2))
    assert isinstance(above, Scene)
    closed = closed_form_orbits(above)
    orbit = find_orbit(above, above.start(Y=closed.Y[0], V=closed.V[0]), throw=True)
    follow = partial(continue_orbit, parameter=RATIO, bounds=RANGE)
    branches = [follow(orbit)]
    for point in branches[0].special:
        if point.kind != "period-doubling":
            continue
        seen: set[float] = set()
        waiting = [point]
        # Each grazing of a doubled motion leads on to the next one; the last leads nowhere.
        while waiting and len(branches) < 4:
            at = waiting.pop()
            try:
                branch = follow(at.switch())
            except ValueError:  # no admissible motion beyond
                continue
            branches.append(branch)
            seen.add(round(at.parameter, 7))
            waiting += [
                p
                for p in branch.special
                if p.kind == "grazing" and round(p.parameter, 7) not in seen
            ]
    return branches


@partial(jit, static_argnames=("settle", "long"))
def _sweeps(scene: Scene, values, starts, settle: int, long: int):
    """Two sweeps, one after each row of values, and the same motions a long time later."""
    longest = 2 * _LONGEST

    def go(start, values):
        return sweep(scene, RATIO, values, start=start, settle=settle, cycles=longest)

    first = jax.vmap(go)(starts, values)
    states = jtu.tree_map(lambda x: x[..., -1].ravel(), first.sections)

    def stay(value, state):
        later = sweep(scene, RATIO, value[None], start=state, settle=long, cycles=longest)
        later = jtu.tree_map(lambda x: x[0], later)
        end = jtu.tree_map(lambda x: x[-1], later.sections)
        return later, _exponent(cycle_map(with_leaf(scene, RATIO, value)), end, 300)

    # Lanes of one batch last as long as their slowest one.
    return jax.lax.map(lambda x: stay(*x), (values.ravel(), states), batch_size=256)


def _exponent(the_map: CycleMap, state: Any, cycles: int) -> jax.Array:
    """Largest Lyapunov exponent per drive cycle: mean growth of a small disturbance."""

    def one(carry, _):
        state, tangent = carry
        state, tangent = jax.jvp(the_map, (state,), (tangent,))
        size = jnp.sqrt(sum(jnp.sum(x * x) for x in jtu.tree_leaves(tangent)))
        size = jnp.maximum(size, 1e-300)
        return (state, jtu.tree_map(lambda x: x / size, tangent)), jnp.log(size)

    begin = (state, jtu.tree_map(jnp.ones_like, state))
    return jnp.mean(jax.lax.scan(one, begin, length=cycles)[1][cycles // 10 :])


def _both(scene: Scene, ratios: np.ndarray, starts, settle: int, long: int):
    """Run-up and close-down, both in the order of rising ζ."""
    values = jnp.asarray(np.stack([ratios, ratios[::-1]]))
    found = _sweeps(scene, values, starts, settle, long)
    sweeps, exponents = jtu.tree_map(lambda x: np.asarray(x).reshape(2, -1, *x.shape[1:]), found)
    up = Settled(jtu.tree_map(lambda x: x[0], sweeps), exponents[0])
    down = Settled(jtu.tree_map(lambda x: x[1, ::-1], sweeps), exponents[1, ::-1])
    return up, down


@partial(jit, static_argnames="cycles")
def _found(scene: Scene, ratios, states, cycles: int) -> Orbit:
    def one(x):
        return find_orbit(with_leaf(scene, RATIO, x[0]), x[1], cycles=cycles)

    return jax.lax.map(one, (ratios, states), batch_size=64)


def describe(found: Response) -> list[Row]:
    """What the sweeps are on between BB' and CC': one row for each motion they keep to.

    Each periodic motion is searched for with `find_orbit` from the sweep's last section state, and
    compared with the closed form where it has one impact per 2π or 4π.
    """
    scene = Scene.ideal(
        frequency_ratio=0.9, restitution=found.restitution, damping_ratio=found.damping_ratio
    )
    return [
        row
        for name, settled in (("run-up", found.up), ("close-down", found.down))
        for row in _rows(found, scene, name, settled)
    ]


def _rows(found: Response, scene: Scene, direction: str, settled: Settled) -> list[Row]:
    at = settled.sweep
    inside = np.flatnonzero(found.inside)
    period, impacts = np.asarray(at.period), np.asarray(at.impacts)
    confirmed = np.zeros(len(found.ratios), bool)
    ends = jtu.tree_map(lambda x: jnp.asarray(x[:, -1]), at.sections)
    for cycles in sorted(set(period[inside].tolist()) - {0}):
        # Always all values, so that another k is not another program.
        orbit = _found(scene, jnp.asarray(found.ratios), ends, cycles)
        near = np.abs(np.asarray(orbit.y_min) - np.asarray(at.y_min)) < 1e-5
        same = (np.asarray(orbit.cycles) == period) & (np.asarray(orbit.impacts) == impacts)
        confirmed |= np.asarray(orbit.stable) & near & same & (period == cycles)
    kind = np.stack([period, np.where(period > 0, np.round(impacts), settled.exponent > _CHAOS)])
    rows = []
    for part in np.split(inside, 1 + np.flatnonzero(np.any(np.diff(kind[:, inside]), axis=0))):
        cycles = int(period[part[0]])
        deviation = np.nan
        if cycles in (1, 2) and round(float(impacts[part[0]])) == 1:
            deviation = _apart(found, cycles, at, part)
        rows.append(
            Row(
                direction=direction,
                low=float(found.ratios[part[0]]),
                high=float(found.ratios[part[-1]]),
                values=len(part),
                cycles=cycles,
                impacts=float(np.mean(impacts[part])),
                exponent=float(np.median(settled.exponent[part])),
                confirmed=int(confirmed[part].sum()),
                deviation=deviation,
                from_short=_apart(found, 1, at, part),
            )
        )
    return rows


def _apart(found: Response, cycles: int, at: Sweep, part: np.ndarray) -> float:
    closed = found.closed[cycles]
    y_min = np.where(closed.admissible[part, 0], closed.y_min[part, 0], np.nan)
    return float(np.max(np.abs(np.asarray(at.y_min)[part] - y_min)))
