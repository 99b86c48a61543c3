"""`minimal_kick`: the smallest change of the state after which a machine settles elsewhere."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from .._checks import count, flag, given_number, interval
from .._messages import Interrupted, at_work
from .._types import State
from ..flow import MethodLike
from ..machine import AbstractMachine, Summarized, components, state_in_words, units_of
from ..orbit import Orbit
from ._edge_state import EdgeState, tracked
from ._rays import NARROWER, Exits, Kick, Row, first_exits, narrowed, nearer, nearest_first
from ._settling import ELSEWHERE, RETURNS, Settling, settling_on
from ._shortest import shortest

# Of the kick, relative to it: by how much more and less simulation confirms it.
_ASIDE = 1e-6

# Two kicks are the same within this, relative to their norm. A choice.
_SAME = 1e-4

# Rounds of looking more closely around the best rays: before Newton's method, and instead of it.
# Choices: the latter narrow a turn of 1/128 to 1e-8.
_LOOKS, _MORE_LOOKS = 2, 14

# Rounds of bisection by eight that leave nothing between two numbers of double precision.
_ROUNDING = 18

# How much longer than what rays found Newton's may be, and how much shorter: else it is another
# kick. A choice, for rays as dense as the default.
_LONGER, _SHORTER = 1e-4, 0.05

# Edges are tracked for so many rounds.
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
    repeat within `longest` cycles or `find_orbit` fails, as for an equilibrium of a machine without
    a drive."""
    edge: EdgeState
    """The edge state: the attractor of motions on the boundary at which the kick ends."""
    residual: Any
    """Relative to the norm: the larger of the distance from the saddle's stable manifold and the
    deviation from a right angle to it. If `exact` is false, the distance between the last kick that
    returns and the first one that does not."""
    exact: bool = eqx.field(static=True)
    """Whether the kick was made exact by the saddle and Newton's method. Otherwise it was found by
    simulations in more and more directions: its norm is accurate to about `residual`, its direction
    to about 1e-4."""
    confirmed: bool = eqx.field(static=True)
    """Whether simulations of 1 - 1e-6 of the kick return and those of 1 + 1e-6 of it settle
    elsewhere."""
    others: tuple["MinimalKick", ...]
    """Local minima of the norm in other directions, the smallest first."""
    lanes: int = eqx.field(static=True)
    """Number of simulations that the search took."""
    machine: AbstractMachine
    """The machine that is kicked."""

    def summary(self) -> str:
        """The kick and where it leads, in words."""
        units = units_of(self.machine)
        parts = state_in_words({name: np.asarray(x) for name, x in self.kick.items()}, 9, units)
        how = "exact" if self.exact else "by simulations only"
        sure = "confirmed" if self.confirmed else "NOT confirmed"
        leads = "no motion that repeats was found"
        if self.settles is not None:
            leads = str(self.settles).splitlines()[0]
        edge = self.edge.summary().splitlines()
        lines = [
            f"Minimal kick of norm {float(self.norm):.9g}: {parts}",
            f"  to: {state_in_words(self.start, 9, units)}{self._when()}",
            f"  settles on: {leads}",
            f"  edge: {edge[0] if len(edge) == 1 else f'{self.edge.kind}, {edge[1]}'}",
            f"  residual {float(self.residual):.1g} ({how}), {sure} by simulation at 1 ± 1e-6",
        ]
        lines += [f"  another: norm {float(other.norm):.9g}" for other in self.others]
        return "\n".join(lines)

    def _when(self) -> str:
        if not self.cycle and not float(self.phase):
            return ""
        return f", {float(self.phase):.9g} after the section of cycle {self.cycle}"


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
    kicks in all directions are simulated, and the first exit of each is bisected; from the best,
    `edge_state` follows the boundary to a saddle, and Newton's method makes the kick exact, through
    the impacts. Simulation from 1 ± 1e-6 of it confirms it. If the boundary has no saddle (a
    chaotic edge, a grazing), directions are narrowed by simulations. An exit and re-entry between
    two points or two rays may be missed. Host-side.

    **Arguments:**

    - `machine`: the machine.
    - `orbit`: the motion that is kicked, on the section: a stable `Orbit`, or a state on a motion
      that repeats; for a machine without a drive also an equilibrium.
    - `components`: names of the numbers of the state that are kicked, such as `["V"]`; all of them
      by default.
    - `weights`: factors of some of them in the norm, positive; 1 by default. If velocities have the
      weight √(m/2) and positions are not kicked, the norm squared is an energy.
    - `bounds`: the range of the kicked state in some of them, such as `{"Y": (-3.0, 2.0)}`.
    - `cycle`: the cycle of an orbit of several cycles in which it is kicked, from 0 on.
    - `phase`: the time after the section of that cycle, in the machine's clock (a crank angle, or a
      time).
    - `largest`: norm up to which kicks are looked for; by default until one leads elsewhere.
    - `directions`, `points`: rays, and points on each that are simulated in a round; `candidates`:
      rays that leave sooner than their neighbours, from which kicks are made exact.
    - `settle`, `tolerance` (far smaller than the kick), `longest`, `method`: as for `edge_state`.
    - `seed`: of the directions, where more than two components are kicked.
    - `progress`: count the starts simulated, in a terminal or a notebook.

    **Returns:** a `MinimalKick`.

    **Raises:** `ValueError` or `TypeError` for arguments that cannot be used, or if no kick leads
    elsewhere; on Ctrl-C `Interrupted`, whose `partial` is the smallest kick found so far.
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

    def kept() -> Interrupted | None:
        return Interrupted("search for kicks", _smallest(kicks, settling)) if kicks else None

    with at_work("minimal kick", kept, progress=progress, unit="start") as settling.tell:
        if phase > 0:
            settling, start = settling.later(start, phase)
            kick = dataclasses.replace(kick, start=start)
        rays = first_exits(settling, kick, directions, points, largest, seed)
        angle = 2 * np.pi / directions ** (1 / max(1, kick.size - 1))  # between neighbours
        best = nearest_first(rays, candidates)
        if not best or not np.isfinite(rays.outside[best[0]]):
            raise ValueError(
                "No kick leads elsewhere, of those that `components`, `bounds` and `largest` "
                "allow: the motion came back from all of them."
            )
        for ray in best:
            unit, radius = rays.directions[ray], float(rays.outside[ray])
            found = _exact(settling, kick, unit, radius, angle, longest, seed)
            new = _described(settling, kick, found, longest, cycle, phase)
            if all(_apart(new, old) > _SAME for old in kicks):
                kicks.append(new)
    return _smallest(kicks, settling)


def _smallest(kicks: list[MinimalKick], settling: Settling) -> MinimalKick:
    """The kick of the least norm, with the others."""
    first, *others = sorted(kicks, key=lambda one: float(one.norm))
    return dataclasses.replace(first, others=tuple(others), lanes=settling.lanes)


_Found = tuple[Row, float, bool, EdgeState]
"""A kick onto the boundary, its residual, whether it is exact, what a motion from it settles on."""


def _exact(
    settling: Settling, kick: Kick, unit: Row, radius: float, angle: float, longest: int, seed: int
) -> _Found:
    """The shortest kick near a ray that leaves the basin at a radius."""
    unit, inside, outside = nearer(settling, kick, unit, radius, angle, _LOOKS, seed)
    line = narrowed(
        settling, kick, Exits(unit[None], np.array([inside]), np.array([outside])), _ROUNDING
    )
    outside = float(line.outside[0])
    ends = kick.rows(np.array([line.inside[0], outside * (1 + _ASIDE)])[:, None] * unit)
    if settling.begin > 0:
        ends = settling.carried(ends, 1)
    edge = tracked(settling.starting(0.0), ends[0], ends[1], longest, _ROUNDS)
    if edge.kind == "saddle" and edge.orbit is not None:
        better = shortest(settling, kick, edge.orbit, unit * outside)
        if better is not None:
            if -_SHORTER <= np.linalg.norm(better[0]) / outside - 1 <= _LONGER:
                return *better, True, edge
    narrow = angle / NARROWER**_LOOKS
    unit, inside, outside = nearer(settling, kick, unit, outside, narrow, _MORE_LOOKS, seed)
    return unit * outside, (outside - inside) / outside, False, edge


def _kick_of(
    settling: Settling,
    start: Row,
    names: Sequence[str] | None,
    weights: Mapping[str, float],
    bounds: Mapping[str, tuple[float, float]],
) -> Kick:
    """The kicks that are asked for.

    **Raises:** `ValueError` or `TypeError` that names the argument.
    """
    numbered = components(settling.state(np.arange(start.size, dtype=start.dtype)))
    places = {name: int(place) for name, place in numbered.items()}
    if isinstance(names, str):
        raise TypeError(f"Argument `components` must be a list of names, but got {names!r}.")
    names = list(places) if names is None else list(names)
    if not names or len({*names}) < len(names):
        raise ValueError(f"Argument `components` must be different names, but got {names!r}.")
    for argument, given in (("components", names), ("weights", weights), ("bounds", bounds)):
        among = list(places) if argument == "components" else names
        for name in given:
            if name not in among:
                raise ValueError(
                    f"Argument `{argument}` must name numbers of the state that are kicked, of "
                    f"{', '.join(among)}, but names {name!r}."
                )
    weigh = [
        given_number(f"weights[{name!r}]", weights.get(name, 1.0), low=0.0, open_low=True)
        for name in names
    ]
    free = (-np.inf, np.inf)
    ranges = [interval("bounds", bounds[name]) if name in bounds else free for name in names]
    low, high = np.array(ranges).T
    kick = Kick(start, tuple(places[name] for name in names), np.array(weigh), low, high)
    if not kick.allowed(np.zeros(kick.size)):
        raise ValueError("Argument `bounds` must hold the state that is kicked, but does not.")
    return kick


def _described(
    settling: Settling, kick: Kick, found: _Found, longest: int, cycle: int, phase: float
) -> MinimalKick:
    """A kick, with what simulation says of it."""
    z, residual, is_exact, edge = found
    aside = kick.rows(np.array([1 - _ASIDE, 1 + _ASIDE])[:, None] * z)
    verdicts = settling.judge(aside)
    row = kick.rows(z)
    changed = components(settling.state(row - kick.start))
    kicked = components(settling.state(np.isin(np.arange(row.size), kick.places).astype(float)))
    return MinimalKick(
        kick={name: x for name, x in changed.items() if kicked[name] > 0},
        norm=float(np.linalg.norm(z)),
        start=settling.state(row),
        settles=settling.settled_orbit(aside[1], longest),
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


def _apart(a: MinimalKick, b: MinimalKick) -> float:
    """How different two kicks are, relative to the norm of one."""
    one, other = (np.array([float(x) for x in kick.kick.values()]) for kick in (a, b))
    return float(np.linalg.norm(one - other) / np.linalg.norm(one))
