"""Special points of branches and of curves in two parameters, and what begins there."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from .._checks import given_number, one_of
from ._conditions import alone
from ._shooting import ROUNDING, Shooting
from ._sliding import SLIDING
from ._solution import Step, orbit_of
from ._words import DETAILS, GRAZING, REST, grazing_in_words, one
from .results import InWords, Orbit

# Where something grazes it is touched to rounding, by choice within this share of the motion.
_TOUCHES = 1e-6


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Point(InWords):
    """A special point: of a branch, or of codimension two on a `Boundary`."""

    kind: str
    """On a branch "fold", "period-doubling", "neimark-sacker", "branch-point", "symmetry-breaking"
    (where motions that are their own image under the symmetry of their machine meet some that are
    not), "grazing", "hopf" (a motion shrinks to an equilibrium), "rest" (a rest on a
    stop is lost, divided, or joined to another one), "crossing-sliding", "grazing-sliding",
    "switching-sliding" or "adding-sliding" (a part in which a switch is held on its surface, as by
    dry friction, vanishes or appears; see the `detail`), "extremum" (of a `quantity` that was asked
    for), "watched" (a `quantity` that is watched passes zero), or "turn" (the parameter turns back
    where others are free; no multiplier need be 1).

    On a boundary "cusp" (two curves of folds meet and end), "degenerate-doubling" or
    "degenerate-symmetry-breaking" (the motions that begin there do so on the other side beyond),
    "fold-flip" (multipliers 1 and -1), "resonance-1:1", "resonance-1:2" (a double multiplier 1 or
    -1, where a curve of Neimark–Sacker points begins), "resonance-1:3", "resonance-1:4" (the angle
    of a complex pair is 2π/3 or π/2), "grazing" (of a motion that is special by its multipliers);
    on a curve of grazings "fold" or "period-doubling" (of the motion that grazes),
    "resonant-grazing" (folds and doublings of the motion with one impact in n periods begin there,
    or with more than two numbers in the state one of both; see `detail`); "symmetry-breaking" (the
    motions become symmetric, and the curve ends; of grazings of symmetric motions, where these lose
    that)."""
    detail: str
    """What happens there, in words."""
    problem: Shooting
    """The equations of the motion in one parameter."""
    step: Step
    """Their solution."""
    impact: int | None = None
    """The impact that grazes; `None` where the body touches a stop that it did not hit before."""
    further: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Value and size of each further parameter of the curve, by name."""
    curve: str | None = None
    """The kind of the boundary on which it lies; `None` on a branch."""
    springs: bool = False
    """Whether the branch springs here from another motion, which `orbit` is then: one of half its
    period, or one without the flight that divides a rest."""
    quantity: str | None = None
    """Of an extremum, or a number that is watched, its name."""
    index: int = -1
    """Which of the curve's points it is; -1 if it lies between two of them."""

    @property
    def scale(self) -> np.ndarray:
        """The size of each unknown."""
        return self.problem.scale

    @property
    def parameter(self) -> float:
        """Value of the (first) parameter."""
        return float(self.step.x[-1])

    @property
    def parameters(self) -> np.ndarray:
        """Values of all parameters of the curve."""
        return np.array([self.parameter, *(value for value, _ in self.further.values())])

    @cached_property
    def orbit(self) -> Orbit:
        """The motion."""
        return orbit_of(self.problem, self.step)

    @property
    def touches(self) -> bool:
        """Whether at a grazing an impact is lost or a stop is touched, to rounding; at a sliding
        bifurcation a surface, by a motion without the part that vanishes there."""
        lost = self.kind == REST or (self.impact is not None and self.kind not in SLIDING)
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

    def switch(self, to: str | None = None, *, distance: float = 0.01) -> Any:
        """Return the start of another curve that begins here: an `Orbit` to be continued, or on a
        boundary mostly a `Point` that `boundary` follows in the same two parameters.

        On a branch: at a period doubling the motion of twice the period, or of half of it where the
        branch begins at one; at a grazing the motion with that impact less or one more, on the side
        on which it is admissible; where branches cross a motion of the other one; at a sliding
        bifurcation the motion that sticks once more or less; where a rest is lost or divided the
        motion with a rest more or less, and where two are joined that with one; where two events
        coincide, as an impact and the section of a machine with `renewed`, the motion with them in
        another order. Other grazings of a machine with soft stops, friction, modes or `events` are
        not switched at: take `find_orbit` beyond it, from a simulated motion.

        On a boundary: at a fold–flip the other curve; at a double multiplier 1 or -1 the curve of
        Neimark–Sacker points, or from that the curve of folds or doublings; at a fold or a doubling
        that grazes the curve of grazings, and back; where a motion that grazes becomes symmetric
        the curve of symmetry breakings; at a resonant grazing the curve of folds or that of
        doublings of the motion with one impact; at a resonance 1:3 or 1:4 an orbit of three or four
        periods, which has other parameters.

        **Arguments:**

        - `to`: where several curves begin, the kind of the one wanted: "fold" (by default) or
          "period-doubling" at a resonant grazing.
        - `distance`: how far from the point an orbit is, in the norm of the scaled unknowns; at a
          resonant grazing about how slow the impact is, as a share of the fastest one there.

        **Raises:** `ValueError` for other kinds, or if there is no admissible motion beyond.
        """
        from ._switch import BEGINS  # which needs this class

        distance = given_number("distance", distance, low=0.0, open_low=True)
        found = BEGINS.get((self.curve, self.kind), {})
        if not found:
            known = ", ".join(kind for curve, kind in BEGINS if curve == self.curve) or "none"
            where = "a branch" if self.curve is None else f"a curve of {self.curve}"
            raise ValueError(
                f"`switch` has nothing to return at {one(self.kind)} of {where}. At these "
                f"kinds it has: {known}. Elsewhere use `find_orbit`, from a simulated motion."
            )
        begins = found[next(iter(found)) if to is None else one_of("to", to, tuple(found))]
        return begins(self, distance)

    def __str__(self) -> str:
        shown = self.parameters[: 1 if self.curve is None else None]
        place = ", ".join(f"{x:.10g}" for x in shown)
        return f"{self.kind} at {f'({place})' if self.curve else place}: {self.detail}"


def point_at(
    problem: Shooting, step: Step, kind: str, detail: str | None = None, impact: int | None = None,
    **more: Any,
) -> Point:  # fmt: skip
    """A special point of a curve, at a solution of its equations; `more`, further fields."""
    if detail is None:
        detail = grazing_in_words(problem, step, impact) if kind == GRAZING else DETAILS[kind]
    further = further_of(problem, step)
    return Point(kind, detail, *alone(problem, step), impact, further, **more)


def further_of(problem: Shooting, step: Step) -> dict[str, tuple[float, float]]:
    """Value and size of each parameter but the first, by name."""
    names, scale = problem.parameters[-2::-1], problem.scale
    return {n: (float(step.x[-i]), float(scale[-i])) for i, n in enumerate(names, 2)}
