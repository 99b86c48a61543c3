"""Special points of branches and of curves in two parameters, and what begins there."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._checks import given_number
from ..machine import others_of
from ._across import across_order, across_sliding, without_part
from ._conditions import alone
from ._corrector import Step, advance, jacobian_at, state_at, tangent_at
from ._flight import Event
from ._observed import ROUNDING
from ._shooting import Shooting
from ._sliding import SLIDING
from ._solution import orbit_of
from ._surgery import repeated, without_events
from ._words import (
    CROSSING,
    DETAILS,
    DOUBLING,
    FLIP,
    FOLD,
    GRAZING,
    RESONANCE_1,
    RESONANCE_2,
    SYMMETRY,
    TORUS,
    grazing_in_words,
    one,
)
from .results import InWords, Orbit

# Where something grazes it is touched to rounding, by choice within this share of the motion.
_TOUCHES = 1e-6


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Point(InWords):
    """A special point: of a branch, or of codimension two on a `Boundary`."""

    kind: str
    """On a branch "fold", "period-doubling", "neimark-sacker", "branch-point", "symmetry-breaking"
    (where motions that are their own image under the symmetry of their machine meet some that are
    not), "grazing", "hopf" (an autonomous machine's motion shrinks to rest), "rest" (a rest on a
    stop is gained or lost), "crossing-sliding", "grazing-sliding", "switching-sliding" or
    "adding-sliding" (a part in which a switch is held on its surface, as by dry friction, vanishes
    or appears; see the `detail`), "extremum" (of a `quantity` that was asked for), "watched" (a
    `quantity` that is watched passes zero), or "turn" (the parameter turns back where others are
    free; no multiplier need be 1).

    On a boundary "cusp" (two curves of folds meet and end), "degenerate-doubling" or
    "degenerate-symmetry-breaking" (the motions that begin there do so on the other side beyond),
    "fold-flip" (multipliers 1 and -1), "resonance-1:1", "resonance-1:2" (a double multiplier 1 or
    -1, where a curve of Neimark–Sacker points begins), "resonance-1:3", "resonance-1:4" (the angle
    of a complex pair is 2π/3 or π/2), "grazing" (of a motion that is special by its multipliers);
    on a curve of grazings "fold" or "period-doubling" (of the motion that grazes),
    "resonant-grazing" (an entry eₙ of the local map vanishes, see `grazing`); "symmetry-breaking"
    (the motions become symmetric, and the curve ends; of grazings of symmetric motions, where these
    lose that)."""
    parameters: np.ndarray
    """Values of the curve's parameters, its own first."""
    detail: str
    """What happens there, in words."""
    problem: Shooting
    """The equations of the motion in one parameter."""
    step: Step
    """Their solution."""
    scale: np.ndarray
    """The size of each unknown."""
    impact: int | None = None
    """The impact that grazes; `None` where the body touches a stop that it did not hit before."""
    curve: str | None = None
    """The kind of the boundary on which it lies; `None` on a branch."""
    springs: bool = False
    """Whether the branch springs here from a motion of half its period, which `orbit` is then."""
    quantity: str | None = None
    """Of an extremum, or a number that is watched, its name."""
    index: int = -1
    """Which of the curve's points it is; -1 if it lies between two of them."""

    @property
    def parameter(self) -> float:
        """Value of the (first) parameter."""
        return float(self.parameters[0])

    @cached_property
    def orbit(self) -> Orbit:
        """The motion."""
        return orbit_of(self.problem, self.step)

    @property
    def touches(self) -> bool:
        """Whether at a grazing an impact is lost or a stop is touched, to rounding; at a sliding
        bifurcation a surface, by a motion without the part that vanishes there."""
        lost = self.impact is not None and self.kind not in SLIDING
        seen = self.step.seen
        # A stop's room is a length; that of a switch a velocity or, while it is held, a force.
        orders = (0,) if self.kind == GRAZING else (1, 2)
        unit = max(seen.length / self.problem.radian**order for order in orders)
        return lost or abs(float(seen.nearest.room)) <= _TOUCHES * unit

    @property
    def lost(self) -> list[int]:
        """Which of the events graze here, of a symmetric motion two at once; none where a stop is
        touched that it did not hit before."""
        if self.impact is None:
            return []
        speed = np.abs(np.asarray(self.step.seen.approach))
        slow = ROUNDING * self.step.seen.fastest
        others = (i for i in self.problem.impacts if speed[i] < slow)
        return sorted({self.impact, *others})

    def switch(self, *, distance: float = 0.01) -> Any:
        """Return the start of the other curve that begins here: on a branch an `Orbit` to be
        continued; on a boundary a `Point` that `boundary` follows in the same two parameters.

        On a branch: at a period doubling the motion of twice the period, or of half of it where the
        branch begins at one; at a grazing the motion with that impact less or one more, on the side
        on which it is admissible; where branches cross a motion of the other one; at a sliding
        bifurcation the motion that sticks once more or less; where two events coincide, as an
        impact and the section of a machine with `renewed`, the motion with them in another order.
        Other grazings of a machine with soft stops, friction, modes or `events` are not switched
        at: take `find_orbit` beyond it, from a simulated motion.

        On a boundary: at a fold–flip the other curve; at a double multiplier 1 or -1 the curve of
        Neimark–Sacker points, or from that the curve of folds or doublings; at a fold or a doubling
        that grazes the curve of grazings, and back; where a motion that grazes becomes symmetric
        the curve of symmetry breakings.

        **Arguments:** on a branch how far from the point (in the norm of the scaled unknowns).

        **Raises:** `ValueError` for other kinds, or if there is no admissible motion beyond.
        """
        distance = given_number("distance", distance, low=0.0, open_low=True)
        begins = _BEGINS.get((self.curve, self.kind))
        if begins is None:
            known = ", ".join(kind for curve, kind in _BEGINS if curve == self.curve) or "none"
            where = "a branch" if self.curve is None else f"a curve of {self.curve}"
            raise ValueError(
                f"`switch` has nothing to return at {one(self.kind)} of {where}. At these "
                f"kinds it has: {known}. Elsewhere use `find_orbit`, from a simulated motion."
            )
        return begins(self, distance)

    def __str__(self) -> str:
        shown = self.parameters[: 1 if self.curve is None else None]
        place = ", ".join(f"{x:.10g}" for x in shown)
        return f"{self.kind} at {f'({place})' if self.curve else place}: {self.detail}"


def point_at(
    problem: Shooting, step: Step, scale: np.ndarray, kind: str, detail: str | None = None,
    impact: int | None = None, **more: Any,
) -> Point:  # fmt: skip
    """A special point of a curve.

    **Arguments:** the curve's equations, their solution, the size of each unknown; further fields
    of the point.
    """
    parameters = np.asarray(step.x)[: -len(problem.parameters) - 1 : -1]
    if detail is None:
        detail = grazing_in_words(problem, step, impact) if kind == GRAZING else DETAILS[kind]
    return Point(kind, parameters, detail, *alone(problem, step, scale), impact, **more)


def _along(point: Point, distance: float) -> Orbit:
    """A motion at this distance from a special point, on the branch that its own equations are
    of."""
    x = np.asarray(point.step.x)
    tangent = tangent_at(point.problem, x, point.scale)
    step = advance(point.problem, x, tangent, point.scale, distance)
    return _found(point.problem, step, "half the period", distance)


def _found(problem: Shooting, step: Step, what: str, distance: float) -> Orbit:
    """The motion at a step. **Raises:** `ValueError` if the corrector found none there."""
    if not bool(step.good):
        raise ValueError(f"No motion of {what} was found at distance {distance:g}; try another.")
    return orbit_of(problem, step)


def doubled(old: Shooting) -> Shooting:
    """The equations of a motion that is gone through twice."""
    events, modes = old.events, old.modes
    if events:
        events, modes = (*events, *(event.later(old.cycles) for event in events)), modes * 2
    return dataclasses.replace(
        old, cycles=2 * old.cycles, events=events, modes=modes, steps=2 * old.steps
    )


def _doubled(point: Point, distance: float) -> Orbit:
    """A motion of twice the period, along what the multiplier -1 makes possible, or of half of it
    where the branch springs from one."""
    if point.springs:
        return _along(point, distance)
    old, new = point.problem, doubled(point.problem)
    x = np.asarray(point.step.x)
    count = len(old.parameters)
    twice = repeated(old, x, new)
    scale = new.scale(point.scale[-count:])
    jacobian = np.asarray(jacobian_at(new, jnp.asarray(twice))) * scale
    # Without the parameter's column the equations have one null vector here: that of -1.
    tangent = np.zeros(len(twice))
    tangent[:-count] = np.linalg.svd(jacobian[:, :-count])[2][-1]
    step = advance(new, twice, tangent, scale, distance)
    return _found(new, step, "twice the period", distance)


def _crossed(point: Point, distance: float) -> Orbit:
    """A motion of the branch that crosses here."""
    problem, x = point.problem, np.asarray(point.step.x)
    jacobian = np.asarray(jacobian_at(problem, jnp.asarray(x))) * point.scale
    # Here the equations have two null vectors: one leads along this branch, the other off it.
    plane = np.linalg.svd(jacobian)[2][-2:]
    along = np.asarray(point.step.tangent)
    along = plane.T @ (plane @ along)
    off = plane[0] * (plane[1] @ along) - plane[1] * (plane[0] @ along)
    off = off / np.linalg.norm(off)
    step = advance(problem, x, off, point.scale, distance)
    return _found(problem, step, "the other branch", distance)


def _held_otherwise(point: Point, distance: float) -> Orbit:
    """The motion on the other side of a sliding bifurcation."""
    found = without_part(point.problem, point.step, point.scale, distance)
    if found is not None:
        return orbit_of(*found)
    what = "another number of times of sticking or sliding"
    return _otherwise(point, across_sliding, what, distance)


def _otherwise(
    point: Point, across: Callable[..., Orbit | None], what: str, distance: float
) -> Orbit:
    """The motion that `across` finds. **Raises:** `ValueError` if it finds none.

    **Arguments:** what the motion has that the branch has not, in words.
    """
    found = across(point.problem, point.step, point.scale, distance)
    if found is None:
        raise ValueError(
            f"No motion with {what} was found at distance {distance:g} from this {point.kind}. "
            "Try another distance."
        )
    return found


def _beyond_grazing(point: Point, distance: float) -> Orbit:
    """The motion with the grazing impact less, or with the touch as an impact more."""
    old, step = point.problem, point.step
    if not old.follows_events:
        raise ValueError(
            "`switch` at a grazing needs a motion without rest on a stop, but this one rests: find "
            "the motion beyond it with `find_orbit`."
        )
    if point.impact is None and not point.touches:
        return _otherwise(point, across_order, "its events in another order", distance)
    if old.modes[0] or others_of(old.machine):
        raise ValueError(
            "`switch` at a grazing needs a machine without soft stops, friction or other switches, "
            "discrete modes and `events`: find the motion beyond it with `find_orbit`."
        )
    if point.impact is not None and old.events[point.impact].cycle is not None:
        raise ValueError(
            "`switch` needs an impact that grazes, but here the section of the machine is touched: "
            "beyond it the motion has another number of cycles. Find it with `find_orbit`."
        )
    if point.impact is not None:
        new, start = without_events(old, np.asarray(step.x), point.lost)
    else:
        new, start = _with_touch(old, step)
    scale = new.scale(point.scale[-1:])
    tangent = tangent_at(new, start, scale)
    for sense in (1.0, -1.0):
        found = advance(new, start, sense * tangent, scale, distance)
        inside = found.seen.nearest.room > 0 and min(found.seen.approach, default=1.0) > 0
        if bool(found.good) and inside:
            return orbit_of(new, found)
    raise ValueError(
        "Beyond this grazing there is no admissible motion with "
        f"{len(new.impacts)} impacts at distance {distance:g}."
    )


def _with_touch(old: Shooting, step: Step) -> tuple[Shooting, np.ndarray]:
    """The equations of a motion at a touch, which is an event there, and their unknowns.

    **Arguments:** the equations of the motion, without modes, and their solution.
    """
    x = jnp.asarray(step.x)
    clock, states = (np.asarray(a) for a in old.parts(x))
    events, value = list(old.events), np.asarray(step.x)[-1:]
    period = float(old.period(x))
    touch = float(step.seen.nearest.clock)
    leg = max(0, int(np.searchsorted(clock, touch, side="right")) - 1) if events else 0
    there = state_at(old, x, jnp.asarray(leg), jnp.asarray(touch))
    u, hit = np.asarray(ravel_pytree(there)[0])[None], Event(int(step.seen.nearest.event))
    if not events:
        clock, states, events = np.array([touch]), u, [hit]
    else:
        clock, states = np.append(clock, touch), np.append(states, u, axis=0)
        order = np.argsort(np.mod(clock, period))
        clock, states = np.mod(clock, period)[order], states[order]
        events = [[*events, hit][i] for i in order]
    new = dataclasses.replace(old, events=tuple(events), modes=((),) * len(events))
    return new, np.asarray(new.pack(clock, states, value, period))


def _of_kind(kind: str) -> Callable[[Point, float], Point]:
    """The motion at a point of a boundary as a special point of this kind."""

    def begins(point: Point, distance: float) -> Point:
        impact = point.impact if kind == GRAZING else None
        found = point_at(point.problem, point.step, point.scale, kind, impact=impact)
        return dataclasses.replace(found, parameters=point.parameters)

    return begins


# What can be switched at, and what begins there: by the kind of the boundary (`None` of a branch)
# and that of the point.
_BEGINS: dict[tuple[str | None, str], Callable[[Point, float], Any]] = {
    (None, DOUBLING): _doubled,
    (None, GRAZING): _beyond_grazing,
    (None, CROSSING): _crossed,
    (None, SYMMETRY): _crossed,
    **{(None, kind): _held_otherwise for kind in SLIDING},
    (FOLD, FLIP): _of_kind(DOUBLING),
    (FOLD, RESONANCE_1): _of_kind(TORUS),
    (FOLD, GRAZING): _of_kind(GRAZING),
    (DOUBLING, FLIP): _of_kind(FOLD),
    (DOUBLING, RESONANCE_2): _of_kind(TORUS),
    (DOUBLING, GRAZING): _of_kind(GRAZING),
    (TORUS, RESONANCE_1): _of_kind(FOLD),
    (TORUS, RESONANCE_2): _of_kind(DOUBLING),
    (TORUS, GRAZING): _of_kind(GRAZING),
    (GRAZING, FOLD): _of_kind(FOLD),
    (GRAZING, DOUBLING): _of_kind(DOUBLING),
    (GRAZING, SYMMETRY): _of_kind(SYMMETRY),
}
