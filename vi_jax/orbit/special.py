"""Special points of branches and of curves in two parameters, and the curves that begin there."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from .._checks import given_number, one_of
from ..machine import in_unit, units_of
from .conditions import in_one_parameter
from .corrector import Step, orbit_of
from .equations import Shooting
from .kinds import GRAZING, KINDS, REST, SLIDING, starts, with_article
from .results import Orbit
from .words import grazing_in_words


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Point:
    """A special point: of a branch, or of codimension two on a `Boundary`."""

    kind: str
    """On a branch "fold", "period-doubling", "neimark-sacker", "branch-point", "grazing";
    "symmetry-breaking" (motions with the symmetry of their machine meet some without it); "hopf" (a
    motion shrinks to an equilibrium); "rest" (a rest on a stop is lost, divided, or joined to
    another); "crossing-sliding", "grazing-sliding", "switching-sliding" or "adding-sliding" (a part
    in which a switch is held on its surface, as by dry friction, vanishes or appears; see the
    `detail`); "extremum" of a `quantity`; "watched" (a watched `quantity` passes zero); "turn" (the
    parameter turns back while others are free; no multiplier need be 1).

    On a boundary "cusp" (two curves of folds meet and end); "degenerate-doubling" or
    "degenerate-symmetry-breaking" (beyond, the motions that begin there do so on the other side);
    "fold-flip" (multipliers 1 and -1); "resonance-1:1", "resonance-1:2" (a double multiplier 1 or
    -1: a curve of Neimark–Sacker points begins); "resonance-1:3", "resonance-1:4" (a complex pair
    has angle 2π/3 or π/2); "grazing" (of a motion with a special multiplier); "symmetry-breaking"
    (the motions become symmetric, and the curve ends). On a curve of grazings "fold" or
    "period-doubling" (of the motion that grazes); "symmetry-breaking" (symmetric motions lose their
    symmetry); "resonant-grazing" (folds and doublings of the motion with one impact in n periods
    begin; with more than two components of the state one of both; see `detail`).
    """
    detail: str
    """A description in words."""
    problem: Shooting
    """The equations of the motion in one parameter."""
    step: Step
    """The solution of these equations."""
    impact: int | None = None
    """The impact that grazes; `None` if the body touches a stop that it did not hit before."""
    further: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    """Value and size of each additional parameter of the curve, by name."""
    curve: str | None = None
    """The kind of the boundary on which it lies; `None` on a branch."""
    is_origin: bool = False
    """True if the branch begins here at another motion, that of `orbit`: one of half its period, or
    one without the flight that divides a rest."""
    quantity: str | None = None
    """Name of the quantity of an extremum or a watched zero."""
    index: int = -1
    """Index of the point on the curve; -1 if it lies between two points."""

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
        """The motion at this point."""
        return orbit_of(self.problem, self.step)

    @property
    def touches(self) -> bool:
        """True if at a grazing an impact is lost or a stop is touched, to rounding; at a sliding
        bifurcation, if the motion without the vanishing part touches a surface."""
        lost = self.kind == REST or (self.impact is not None and self.kind not in SLIDING)
        return lost or self.step.observed.touches

    @property
    def lost(self) -> list[int]:
        """Indices of the impacts that graze here, two at once in a symmetric motion; empty if a
        stop is touched that the motion did not hit before."""
        if self.impact is None:
            return []
        lost = self.step.observed.lost
        return sorted({self.impact, *(i for i in self.problem.impacts if lost[i])})

    def switch(self, to: str | None = None, *, distance: float = 0.01) -> Any:
        """Return the start of another curve that begins here: an `Orbit` to be continued, or on a
        boundary a `Point` that `boundary` follows in the same two parameters.

        On a branch: at a period doubling the motion of twice the period, or of half of it if the
        branch begins at one; at a Neimark–Sacker point a `Torus` (for `continue_torus`), which has
        another value of the parameter; at a grazing the motion with one impact less or more, on the
        side on which it is admissible; at a branch point a motion of the other branch; at a sliding
        bifurcation the motion that sticks once more or less; at a lost or divided rest the motion
        with one rest more or less, at joined rests that with one; where two events coincide, as an
        impact and the section of a machine with `renewed`, the motion with them in another order.
        Other grazings of a machine with soft stops, friction, modes or `events` are not supported:
        use `find_orbit` beyond them, from a simulated motion.

        On a boundary: at a fold–flip the other curve; at a double multiplier 1 or -1 the curve of
        Neimark–Sacker points, or from that the curve of folds or doublings; at a fold or doubling
        that grazes the curve of grazings, and back; where a motion that grazes becomes symmetric
        the curve of symmetry breakings; at a resonant grazing the curve of folds or doublings of
        the motion with one impact.

        **Arguments:**

        - `to`: the kind of the curve if several begin: "fold" (by default) or "period-doubling" at
          a resonant grazing.
        - `distance`: distance of an orbit from the point, in the norm of the scaled unknowns; of a
          torus the size of its first Fourier mode; at a resonant grazing about the speed of the
          impact, as a share of the fastest one there.

        **Raises:** `ValueError` for other kinds, or if there is no admissible motion beyond.
        """
        from . import switch  # noqa: F401  # it registers what begins at special points

        distance = given_number("distance", distance, low=0.0, open_low=True)
        here = starts.get((self.curve, self.kind), {})
        if not here:
            known = ", ".join(kind for curve, kind in starts if curve == self.curve) or "none"
            owner = "a branch" if self.curve is None else f"a curve of {self.curve}"
            raise ValueError(
                f"`switch` has nothing to return at {with_article(self.kind)} of {owner}. At these "
                f"kinds it has: {known}. Elsewhere use `find_orbit`, from a simulated motion."
            )
        start = here[next(iter(here)) if to is None else one_of("to", to, tuple(here))]
        return start(self, distance)

    def __repr__(self) -> str:
        units, names = units_of(self.problem.machine), (self.problem.parameters[-1], *self.further)
        values = zip(names, self.parameters, strict=True)
        found = [in_unit(f"{x:.10g}", units, name) for name, x in values]
        place = found[0] if self.curve is None else ", ".join(found)
        return f"{self.kind} at {f'({place})' if self.curve else place}: {self.detail}"


def point_at(
    problem: Shooting, step: Step, kind: str, detail: str | None = None, impact: int | None = None,
    **more: Any,
) -> Point:  # fmt: skip
    """Return a special point of a curve at a solution of its equations; `more` are other fields."""
    if detail is None:
        detail = grazing_in_words(problem, step, impact) if kind == GRAZING else KINDS[kind].detail
    further = further_of(problem, step)
    return Point(kind, detail, *in_one_parameter(problem, step), impact, further, **more)


def further_of(problem: Shooting, step: Step) -> dict[str, tuple[float, float]]:
    """Return value and size of each parameter but the first, by name."""
    names, scale = problem.parameters[-2::-1], problem.scale
    return {n: (float(step.x[-i]), float(scale[-i])) for i, n in enumerate(names, 2)}
