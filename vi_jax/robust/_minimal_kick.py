"""`minimal_kick`: the smallest change of the state after which a machine settles elsewhere.

Rays of kicks are simulated until they leave the basin (`first_exits`). The basin's boundary near
the shortest kick is the stable manifold of a saddle xₛ: the images Pⁿ(x) of its states x have no
component along the saddle's unstable direction (`shortest`). With w the left eigenvector of the
saddle's monodromy matrix for its multiplier outside the unit circle,

    g(z) = w·(Pⁿ(x(z)) - xₛ) = 0,

up to the square of Pⁿ(x) - xₛ, which shrinks as n grows. The minimum of |z|² under this condition
satisfies Lagrange's equations z = λ∇g, g = 0, which Newton's method solves. ∇g is exact, through
the impacts; its own derivatives are differences of ∇g between neighbouring lanes.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._checks import count, flag, given_number, host_side, interval, on_host
from .._messages import at_work
from .._types import State
from ..flow import MethodLike
from ..machine import AbstractMachine, Summarized, components, in_rows, state_in_words, units_of
from ..orbit import CORRECTED, FAINT, LOCATED, Orbit, cycle_map
from ._edge_state import EdgeState, track_edge
from ._settling import ELSEWHERE, RETURNS, Row, Rows, Settling, images, settling_on

Kicks = Float[np.ndarray, "..."]
"""Kicks, the components in the last axis."""

# Bits by which a round narrows an exit, in one program; rounds before exits are compared. Choices.
_BITS, _COARSE = 3, 7

# Rounds that leave nothing between two numbers of double precision.
_ALL_BITS = math.ceil(np.finfo(float).nmant / _BITS)

# Most doublings of the rays until one leaves; most additional periods, and Newton steps for each.
# Choices.
_MOST = 12

# Directions around the best, per dimension; a round narrows them by this factor. Choices.
AROUND, NARROWER = 12, 3.0


class Kick(eqx.Module):
    """The space of kicks: components of the state, their weights and their ranges.

    A kick is a vector in units of the weights: component i of the state changes by zᵢ/wᵢ, and |z|
    is the kick's norm.
    """

    start: Row
    """The state that is kicked."""
    places: tuple[int, ...] = eqx.field(static=True)
    """Indices of the components among those of the state."""
    weights: Row
    low: Row
    """The lower bound of each component, or -∞."""
    high: Row

    @property
    def size(self) -> int:
        return len(self.places)

    def rows(self, z: Kicks) -> Any:
        rows = np.broadcast_to(self.start, (*z.shape[:-1], self.start.size)).copy()
        rows[..., self.places] += z / self.weights
        return rows

    def allowed(self, z: Kicks) -> Bool[np.ndarray, "..."]:
        kicked = self.rows(z)[..., self.places]
        return np.asarray(((kicked >= self.low) & (kicked <= self.high)).all(axis=-1))


@dataclasses.dataclass(frozen=True)
class Exits:
    directions: Kicks
    """Unit vectors, (rays, components)."""
    inside: Float[np.ndarray, " rays"]
    """The last radius on each ray that returns, before the first that does not."""
    outside: Float[np.ndarray, " rays"]
    """The first radius that does not return; infinite if a ray ends before (a stop, a bound)."""


def ray_directions(count: int, size: int, seed: int) -> Kicks:
    """Return directions: both, evenly around a circle, or at random in more dimensions."""
    if size == 1:
        return np.array([[1.0], [-1.0]])
    if size == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = np.random.default_rng(seed).normal(size=(count, size))
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def exits(
    settling: Settling, kick: Kick, directions: Kicks, inside: Any, outside: Any, points: int
) -> Exits:
    """Return the first point of each ray that does not return, of `points` between two radii."""
    parts = np.arange(1, points + 1) / points
    inside = np.broadcast_to(inside, len(directions)).astype(float)
    outside = np.broadcast_to(outside, len(directions)).astype(float)
    radii = inside[:, None] + parts * (outside - inside)[:, None]
    z = radii[..., None] * directions[:, None]
    # Points beyond a bound are not judged: the ray ends at the last point within.
    within = np.logical_and.accumulate(kick.allowed(z), axis=1).sum(axis=1)
    rows = kick.rows(z)
    rows[~kick.allowed(z)] = kick.start
    place, leaves = settling.first_change(rows)
    leaves &= place < within
    all_radii = np.concatenate([inside[:, None], radii], axis=1)
    rays = np.arange(len(directions))
    last = all_radii[rays, np.minimum(np.where(leaves, place, 0), points)]
    first = np.where(leaves, all_radii[rays, np.minimum(place + 1, points)], np.inf)
    return Exits(directions, last, first)


def narrowed(settling: Settling, kick: Kick, found: Exits, rounds: int) -> Exits:
    """Narrow the brackets of exits in several rounds."""
    good = np.isfinite(found.outside)
    inside, outside = found.inside[good], found.outside[good]
    directions = found.directions[good]
    for _ in range(rounds):
        if not good.any() or np.all(outside - inside <= 4e-16 * outside):
            break
        new = exits(settling, kick, directions, inside, outside, 2**_BITS)
        # The outer end of a bracket was judged before; a bracket without a change is kept.
        same = ~np.isfinite(new.outside)
        inside = np.where(same, inside, new.inside)
        outside = np.where(same, outside, new.outside)
    return Exits(directions, inside, outside)


def first_exits(
    settling: Settling, kick: Kick, directions: int, points: int, largest: float | None, seed: int
) -> Exits:
    """Return the exits of rays in all directions from the basin, each to some bits.

    The rays grow until one leaves. Then as many points are set on the rays up to the
    shortest exit. This is repeated while it shrinks to less than half.
    """
    rays = ray_directions(directions, kick.size, seed)
    reach = largest
    if reach is None:
        sizes = (settling.motion.sizes + np.abs(kick.start))[list(kick.places)]
        reach = float(np.max(kick.weights * sizes)) / 4
    found = exits(settling, kick, rays, 0.0, reach, points)
    for _ in range(_MOST if largest is None else 0):
        if np.isfinite(found.outside).any():
            break
        reach *= 2
        found = exits(settling, kick, rays, 0.0, reach, points)
    while np.isfinite(found.outside).any():
        least = found.outside.min()
        closer = exits(settling, kick, rays, 0.0, least, points)
        is_closer = closer.outside < found.outside
        inside = np.where(is_closer, closer.inside, found.inside)
        found = Exits(rays, inside, np.where(is_closer, closer.outside, found.outside))
        if found.outside.min() > 0.5 * least:
            break
    return narrowed(settling, kick, found, _COARSE)


def nearest_first(found: Exits, most: int) -> list[tuple[Row, float]]:
    """Return directions and radii of the exits that are earlier than their neighbours', the
    earliest first, at most so many. A ray has two neighbours around a circle, three per dimension
    (a choice) in more."""
    units, size = found.directions, found.directions.shape[1]
    neighbours = 3 * size if size > 2 else 2 * (size - 1)
    near = np.argsort(-(units @ units.T), axis=1, kind="stable")[:, 1 : neighbours + 1]
    least = found.outside <= np.min(found.outside[near], axis=1, initial=np.inf)
    order = np.argsort(found.outside, kind="stable")
    best = [int(i) for i in order if least[i]][:most]
    if not best or not np.isfinite(found.outside[best[0]]):
        raise ValueError(
            "No kick leads elsewhere, of those that `components`, `bounds` and `largest` allow: "
            "the motion came back from all of them."
        )
    return [(units[i], float(found.outside[i])) for i in best]


def refine_direction(
    settling: Settling, kick: Kick, unit: Row, radius: float, angle: float, rounds: int, seed: int
) -> tuple[Row, float, float]:
    """Refine a direction around the best in ever smaller angles; return that with the earliest
    exit, its last radius that returns and the first that does not."""
    rng = np.random.default_rng(seed)
    best: tuple[Row, float, float] = unit, 0.0, radius
    for _ in range(rounds):
        around = _around(best[0], angle, rng)
        coarse = exits(settling, kick, around, 0.0, best[2] * (1 + angle**2), 2 * AROUND)
        # At so large an angle the norm changes by its square, or decreases.
        rounds_here = min(_ALL_BITS, math.ceil(-math.log2(angle**2) / _BITS) + 1)
        found = narrowed(settling, kick, coarse, max(1, rounds_here))
        if len(found.outside):
            i = int(np.argmin(found.outside))
            if found.outside[i] <= best[2]:
                best = found.directions[i], float(found.inside[i]), float(found.outside[i])
        angle /= NARROWER
    return best


def _around(unit: Row, angle: float, rng: np.random.Generator) -> Kicks:
    """Return directions within an angle of another one, and that one."""
    if unit.size == 1:
        return unit[None]
    across = np.linalg.svd(unit[None])[2][1:]
    if unit.size == 2:
        steps = np.linspace(-angle, angle, 2 * AROUND + 1)[:, None]
    else:
        steps = rng.normal(size=(AROUND * unit.size, unit.size - 1)) * angle / 2
        steps = np.concatenate([np.zeros((1, unit.size - 1)), steps])
    z = np.asarray(unit) + np.asarray(steps) @ across
    return z / np.linalg.norm(z, axis=1, keepdims=True)


# Newton's method begins where the motion on the edge is this near to the saddle; it adds periods
# until a kick is `CORRECTED`, relative to its norm. A choice.
_NEAR_SADDLE = 0.05

# A change below this, relative to the norm, is the method's error if it exceeds half the one
# before: adaptive steps of 1e-11 leave some 1e-9 in a gradient. The kick is then final. A choice.
_NOISE = 1e-7

# Size of the differences of gradients, relative to the norm of the kick; and the longest step.
_DIFFERENCE, _STEP = 1e-5, 0.2

# A kick that moves by more than this, relative to its norm, is another one than at first.
_FARTHEST = 0.5


def shortest(settling: Settling, kick: Kick, saddle: Orbit, z: Row) -> tuple[Row, float] | None:
    """Return the kick of least norm onto the stable manifold of a saddle, near a kick onto it that
    is known to rounding, and its residual relative to its norm: the larger of its distance from the
    manifold to first order and its deviation from a right angle to it. `None` if Newton's method
    fails, as near a grazing."""
    rows, normals = _frame(settling, saddle)
    if not np.isfinite(normals).all():
        return None
    period = len(rows)
    # A motion that begins within rounding of the manifold stays near it for so many periods.
    growth = float(np.max(np.abs(np.asarray(saddle.multipliers))))
    longest = int(np.clip(np.log(1e14) / np.log(growth), 8, 400))
    section_states = settling.section_states(kick.rows(z)[None], longest * period)[0]
    distances = settling.motion.between(section_states[1:, None], rows)
    near = np.flatnonzero(distances.min(axis=1) <= _NEAR_SADDLE)
    if not near.size:
        return None
    place = int(distances[near[0]].argmin())

    def edge(z: Kicks, cycles: int) -> tuple[Row, Kicks]:
        numbers = map(np.asarray, (kick.rows(z), cycles, settling.begin))
        ends, jacobian = images(settling.the_map, settling.like, *numbers)
        slope = normals[place] @ np.asarray(jacobian)[:, :, list(kick.places)]
        offsets = settling.motion.near(np.asarray(ends), rows[place]) - rows[place]
        return offsets @ normals[place], slope / kick.weights

    first, before, last = z, None, np.inf
    for added in range(_MOST):
        found = _newton(functools.partial(edge, cycles=int(near[0]) + 1 + added * period), z)
        if found is None or np.linalg.norm(found[0] - first) > _FARTHEST * np.linalg.norm(first):
            return before
        change, z = float(np.linalg.norm(found[0] - z) / np.linalg.norm(z)), found[0]
        if added and _is_converged(change, last):
            return found
        before, last = found if added else None, change
    return before


def _is_converged(change: float, last: float) -> bool:
    """Return whether a change, relative to the norm, is zero or within the method's error."""
    return change <= CORRECTED or last / 2 <= change <= _NOISE


def _frame(settling: Settling, saddle: Orbit) -> tuple[Rows, Rows]:
    """Return section states of a saddle, and its left unstable unit eigenvector at each."""
    period = int(saddle.cycles)
    rows = in_rows(on_host(saddle.sections))[:period]
    the_map = settling.the_map
    whole = cycle_map(the_map.machine, period, method=the_map.method)
    normals = []
    for row in rows:
        state = settling.state(row)
        jacobian = np.asarray(whole.jacobian(state))
        if not np.isfinite(jacobian).all():
            return rows, np.full_like(rows, np.nan)
        values, vectors = np.linalg.eig(jacobian.T)
        normal = np.real(vectors[:, np.argmax(np.abs(values))])
        normals.append(normal / np.linalg.norm(normal))
    return rows, np.array(normals)


def _newton(edge: Callable[[Kicks], tuple[Row, Kicks]], z: Row) -> tuple[Row, float] | None:
    """Solve as `shortest` does; `edge` returns g and its gradient at some kicks."""
    size, multiplier, last = z.size, None, np.inf
    for _ in range(_MOST):
        step = _DIFFERENCE * np.linalg.norm(z)
        offsets = step * np.eye(size)
        values, slopes = edge(np.concatenate([z[None], z + offsets, z - offsets]))
        if not np.isfinite(slopes).all() or not np.any(slopes[0]):
            return None
        # In units in which the gradient has length one.
        unit = np.linalg.norm(slopes[0])
        value, slope = values[0] / unit, slopes[0] / unit
        hessian = (slopes[1 : size + 1] - slopes[size + 1 :]) / (2 * step * unit)
        if multiplier is None:
            multiplier = float(z @ slope)
        residual = np.concatenate([z - multiplier * slope, [value]])
        matrix = np.zeros((size + 1, size + 1))
        matrix[:size, :size] = np.eye(size) - multiplier * 0.5 * (hessian + hessian.T)
        matrix[:size, size], matrix[size, :size] = -slope, slope
        try:
            change = np.linalg.solve(matrix, -residual)
        except np.linalg.LinAlgError:
            return None
        length, norm = float(np.linalg.norm(change[:size])), float(np.linalg.norm(z))
        change *= min(1.0, _STEP * norm / length) if length else 1.0
        z = z + change[:size]
        multiplier = None if length > _STEP * norm else multiplier + float(change[size])
        if _is_converged(length / norm, last):
            return z, float(np.max(np.abs(residual)) / norm)
        last = length / norm
    return None


# Rounds of refinement around the best rays: before Newton's method, and instead of it. Choices: the
# latter narrow a turn of 1/128 to 1e-8.
_FEW_ROUNDS, _MANY_ROUNDS = 2, 14

# Newton's kick may be shorter than that of the rays by this share, and not longer: otherwise it is
# another kick. A choice, for rays as dense as the default.
_SHORTER = 0.05

# Most rounds of edge tracking.
_ROUNDS = 40


class MinimalKick(Summarized):
    """The smallest change of a state after which a machine settles elsewhere."""

    kick: dict[str, Any]
    """The change of each component that is kicked."""
    norm: Any
    """√(Σ (weight·kick)²)."""
    start: State
    """The state just after the kick, on the boundary of the basin."""
    cycle: int = eqx.field(static=True)
    """The cycle of the period in which the motion is kicked."""
    phase: Any
    """The time of the kick after the section of that cycle, in the machine's clock."""
    settles: Orbit | None
    """The motion on which the machine settles after a slightly harder kick; `None` if it does not
    repeat within `longest` cycles or `find_orbit` fails, as for equilibria without a drive."""
    edge: EdgeState
    """The edge state: the attractor of motions on the boundary at which the kick ends."""
    residual: Any
    """Relative to the norm: the larger of the distance from the saddle's stable manifold and the
    deviation from a right angle to it. If `exact` is false, the distance between the last kick that
    returns and the first one that does not."""
    exact: bool = eqx.field(static=True)
    """True if the kick was made exact by the saddle and Newton's method. Otherwise it was found by
    simulations in many directions: its norm is accurate to about `residual`, its direction 1e-4."""
    confirmed: bool = eqx.field(static=True)
    """True if simulations of 1 - 1e-6 of the kick return and those of 1 + 1e-6 settle elsewhere."""
    others: tuple["MinimalKick", ...]
    """Local minima of the norm in other directions, the smallest first."""
    lanes: int = eqx.field(static=True)
    """Number of simulations that the search took."""
    machine: AbstractMachine
    """The machine that is kicked."""

    def summary(self) -> str:
        """Describe the kick and the motion after it, in words."""
        units = units_of(self.machine)
        parts = state_in_words({name: np.asarray(x) for name, x in self.kick.items()}, 9, units)
        how = "exact" if self.exact else "by simulations only"
        confirmed = "confirmed" if self.confirmed else "NOT confirmed"
        when = f", {float(self.phase):.9g} after the section of cycle {self.cycle}"
        when = when if self.cycle or float(self.phase) else ""
        settles = "no motion that repeats was found"
        if self.settles is not None:
            settles = str(self.settles).splitlines()[0]
        edge = self.edge.summary().splitlines()
        lines = [
            f"Minimal kick of norm {float(self.norm):.9g}: {parts}",
            f"  to: {state_in_words(self.start, 9, units)}{when}",
            f"  settles on: {settles}",
            f"  edge: {edge[0] if len(edge) == 1 else f'{self.edge.kind}, {edge[1]}'}",
            f"  residual {float(self.residual):.1g} ({how}), {confirmed} by simulation at 1 ± 1e-6",
        ]
        lines += [f"  another: norm {float(other.norm):.9g}" for other in self.others]
        return "\n".join(lines)


@host_side
def minimal_kick(
    machine: AbstractMachine,
    orbit: Orbit | State,
    *,
    components: Sequence[str] | None = None,
    weights: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    cycle: int = 0,
    phase: float = 0.0,
    largest: float | None = None,
    directions: int = 128,
    points: int = 32,
    candidates: int = 3,
    settle: int = 1000,
    tolerance: float = 1e-4,
    longest: int = 8,
    seed: int = 0,
    method: MethodLike = None,
    progress: bool = True,
) -> MinimalKick:
    """Find the smallest kick (jump of the state) after which a stable motion does not return.

    It leads onto the boundary of the basin, the stable manifold of an unstable motion. Rays of
    kicks in all directions are simulated, and the first exit of each is bisected. From the best,
    `edge_state` follows the boundary to a saddle, and Newton's method makes the kick exact, through
    the impacts. Simulations with 1 ± 1e-6 of it confirm it. If the boundary has no saddle (a
    chaotic edge, a grazing), directions are narrowed by simulations. An exit and re-entry between
    two points or two rays may be missed. Host-side.

    **Arguments:**

    - `machine`: the machine.
    - `orbit`: the motion that is kicked, on the section: a stable `Orbit`, or a state on a motion
      that repeats; for a machine without a drive also an equilibrium.
    - `components`: names of the components of the state that are kicked, such as `["V"]`; by
      default all.
    - `weights`: factors of some components in the norm, positive; 1 by default. If velocities have
      the weight √(m/2) and positions are not kicked, the norm squared is an energy.
    - `bounds`: range of the kicked state in some components, such as `{"Y": (-3.0, 2.0)}`.
    - `cycle`: the cycle of an orbit of several cycles in which it is kicked, from 0 on.
    - `phase`: the time after the section of that cycle, in the machine's clock (a crank angle, or a
      time).
    - `largest`: largest norm of the search; by default it continues until a kick leads elsewhere.
    - `directions`, `points`: number of rays, and of points on each that are simulated in a round;
      `candidates`: number of rays with earlier exits than their neighbours' whose kicks are made
      exact.
    - `settle`, `tolerance` (far smaller than the kick), `longest`, `method`: as for `edge_state`.
    - `seed`: seed of the directions, if more than two components are kicked.
    - `progress`: whether to count the simulated starts, in a terminal or a notebook.

    **Returns:** a `MinimalKick`.

    **Raises:** `ValueError` or `TypeError` for invalid arguments, or if no kick leads elsewhere. On
    Ctrl-C `Interrupted`, whose `partial` is the smallest kick found so far.
    """
    cycle, candidates = count("cycle", cycle), count("candidates", candidates, least=1)
    directions, points = count("directions", directions, least=4), count("points", points, least=2)
    longest, seed = count("longest", longest, least=1), count("seed", seed)
    progress, phase = flag("progress", progress), given_number("phase", phase, low=0.0)
    if largest is not None:
        largest = given_number("largest", largest, low=0.0, open_low=True)
    settling, start = settling_on(
        machine, orbit, settle, tolerance, longest, method, "orbit", cycle
    )
    kick = _kick_of(settling, start, components, weights or {}, bounds or {})
    kicks: list[MinimalKick] = []

    found = lambda: _smallest(kicks, settling) if kicks else None
    with at_work("search for kicks", found, progress=progress, unit="start") as settling.report:
        if phase > 0:
            settling, start = settling.at_phase(start, phase)
            kick = dataclasses.replace(kick, start=start)
        rays = first_exits(settling, kick, directions, points, largest, seed)
        angle = 2 * np.pi / directions ** (1 / max(1, kick.size - 1))  # between neighbours
        for unit, radius in nearest_first(rays, candidates):
            exact = _exact(settling, kick, unit, radius, angle, longest, seed)
            new = _described(settling, kick, exact, longest, cycle, phase)
            if all(_distance(new, old) > FAINT for old in kicks):
                kicks.append(new)
    return _smallest(kicks, settling)


def _smallest(kicks: list[MinimalKick], settling: Settling) -> MinimalKick:
    first, *others = sorted(kicks, key=lambda one: float(one.norm))
    return dataclasses.replace(first, others=tuple(others), lanes=settling.lanes)


_Found = tuple[Row, float, bool, EdgeState]
"""A kick onto the boundary, its residual, whether it is exact, and its edge state."""


def _exact(
    settling: Settling, kick: Kick, unit: Row, radius: float, angle: float, longest: int, seed: int
) -> _Found:
    """Return the shortest kick near a ray that leaves the basin at a radius."""
    unit, inside, outside = refine_direction(settling, kick, unit, radius, angle, _FEW_ROUNDS, seed)
    line = Exits(unit[None], np.array([inside]), np.array([outside]))
    line = narrowed(settling, kick, line, _ALL_BITS)
    outside = float(line.outside[0])
    ends = kick.rows(np.array([line.inside[0], outside * (1 + LOCATED)])[:, None] * unit)
    if settling.begin > 0:
        ends = settling.states_after(ends, 1)
    edge = track_edge(settling.starting_at(0.0), ends[0], ends[1], longest, _ROUNDS)
    if edge.kind == "saddle" and edge.orbit is not None:
        better = shortest(settling, kick, edge.orbit, unit * outside)
        longer = np.nan if better is None else np.linalg.norm(better[0]) / outside - 1
        if better is not None and -_SHORTER <= longer <= FAINT:
            return *better, True, edge
    narrow = angle / NARROWER**_FEW_ROUNDS
    unit, inside, outside = refine_direction(
        settling, kick, unit, outside, narrow, _MANY_ROUNDS, seed
    )
    return unit * outside, (outside - inside) / outside, False, edge


def _kick_of(
    settling: Settling,
    start: Row,
    names: Sequence[str] | None,
    weights: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
) -> Kick:
    numbered = components(settling.state(np.arange(start.size, dtype=start.dtype)))
    places = {name: int(place) for name, place in numbered.items()}
    if isinstance(names, str):
        raise TypeError(f"Argument `components` must be a list of names, but got {names!r}.")
    names = list(places) if names is None else list(names)
    if not names or len({*names}) < len(names):
        raise ValueError(f"Argument `components` must be different names, but got {names!r}.")
    for argument, given in (("components", names), ("weights", weights), ("bounds", bounds)):
        known = list(places) if argument == "components" else names
        for name in given:
            if name not in known:
                raise ValueError(
                    f"Argument `{argument}` must name numbers of the state that are kicked, of "
                    f"{', '.join(known)}, but names {name!r}."
                )
    weight_row = [
        given_number(f"weights[{name!r}]", weights.get(name, 1.0), low=0.0, open_low=True)
        for name in names
    ]
    free = (-np.inf, np.inf)
    ranges = [interval("bounds", bounds[name]) if name in bounds else free for name in names]
    low, high = np.array(ranges).T
    kick = Kick(start, tuple(places[name] for name in names), np.array(weight_row), low, high)
    if not kick.allowed(np.zeros(kick.size)):
        raise ValueError("Argument `bounds` must hold the state that is kicked, but does not.")
    return kick


def _described(
    settling: Settling, kick: Kick, found: _Found, longest: int, cycle: int, phase: float
) -> MinimalKick:
    z, residual, is_exact, edge = found
    rows = kick.rows(np.array([1 - LOCATED, 1 + LOCATED])[:, None] * z)
    verdicts = settling.judge(rows)
    row = kick.rows(z)
    changed = components(settling.state(row - kick.start))
    kicked = components(settling.state(np.isin(np.arange(row.size), kick.places).astype(float)))
    return MinimalKick(
        kick={name: x for name, x in changed.items() if kicked[name] > 0},
        norm=float(np.linalg.norm(z)),
        start=settling.state(row),
        settles=settling.settled_orbit(rows[1], longest),
        cycle=cycle,
        phase=phase,
        edge=edge,
        residual=float(residual),
        exact=is_exact,
        confirmed=bool(verdicts[0] == RETURNS and verdicts[1] == ELSEWHERE),
        others=(),
        lanes=settling.lanes,
        machine=settling.the_map.machine,
    )


def _distance(a: MinimalKick, b: MinimalKick) -> float:
    one, other = (np.array([float(x) for x in kick.kick.values()]) for kick in (a, b))
    return float(np.linalg.norm(one - other) / np.linalg.norm(one))
