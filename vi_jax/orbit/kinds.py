"""The kinds of special points of branches and boundaries: one table, from which all parts read.

A kind that is followed in two parameters has a dash, and a condition in `conditions.Special`. The
curves that begin at a point of a kind register themselves (`starts`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

FOLD, DOUBLING, TORUS = "fold", "period-doubling", "neimark-sacker"
GRAZING, CROSSING, SYMMETRY = "grazing", "branch-point", "symmetry-breaking"
HOPF, REST, EXTREMUM, TURN, WATCHED = "hopf", "rest", "extremum", "turn", "watched"
CROSSING_SLIDING, GRAZING_SLIDING = "crossing-sliding", "grazing-sliding"
SWITCHING_SLIDING, ADDING_SLIDING = "switching-sliding", "adding-sliding"

# Kinds of points of codimension two.
CUSP, FLIP, RESONANT = "cusp", "fold-flip", "resonant-grazing"
DEGENERATE, DEGENERATE_SYMMETRY = "degenerate-doubling", "degenerate-symmetry-breaking"
RESONANCE_1, RESONANCE_2 = "resonance-1:1", "resonance-1:2"
RESONANCE_3, RESONANCE_4 = "resonance-1:3", "resonance-1:4"

# A turn of a branch that begins at another branch and leaves it to both sides: a branch point.
TURNS = "turns"


class Kind(NamedTuple):
    """A row of the table."""

    mark: tuple[str, str]
    """The marker in pictures, and its colour."""
    detail: str = ""
    """The description on a branch."""
    on_curve: str = ""
    """The description on a boundary."""
    parts: tuple[str, str] | None = None
    """The descriptions at a sliding bifurcation, of a motion without the brief part and of one with
    it, for the `name` of a switch and a `place`."""
    multiplier: float = 1.0
    """The real multiplier that passes the unit circle there, or the product of the pair."""
    dash: Any = None
    """The dash of the curve of such points in two parameters; `None` if it is not followed."""


KINDS = {
    GRAZING: Kind(("o", "k"), dash="-"),
    FOLD: Kind(
        ("s", "w"), "a multiplier passes 1 and the branch turns back",
        "the motion that grazes has a multiplier 1",
        dash=(0, (6, 1.5, 1.2, 1.5)),
    ),
    DOUBLING: Kind(
        ("D", "0.7"), "a multiplier passes -1", "the motion that grazes has a multiplier -1",
        multiplier=-1.0, dash=(0, (5, 2)),
    ),
    TORUS: Kind(
        ("^", "w"), "a complex pair of multipliers leaves the unit circle",
        dash=(0, (5, 1.5, 1.2, 1.5, 1.2, 1.5)),
    ),
    CROSSING: Kind(
        ("X", "k"), "a multiplier passes 1 and another branch crosses",
        dash=(0, (1.2, 2.4)),
    ),
    SYMMETRY: Kind(
        ("P", "w"), "a multiplier passes 1 and the motion loses its symmetry",
        "the motion loses or gains its symmetry: a curve of symmetry breakings comes here",
        dash=(0, (1.2, 1.2)),
    ),
    HOPF: Kind(("*", "0.7"), "the motion shrinks to an equilibrium"),
    REST: Kind(("h", "0.7"), dash=(0, (2, 2))),
    EXTREMUM: Kind(("d", "w")),
    WATCHED: Kind(("$w$", "k")),
    TURN: Kind(("<", "w"), "the parameter turns back while other quantities are held"),
    CROSSING_SLIDING: Kind(
        ("$c$", "k"), dash=(0, (3, 1, 1, 1)),
        parts=(
            "{name} passes its surface {place}, and beyond is held there for a while",
            "{name} is no longer held {place}, and beyond passes its surface there at once",
        ),
    ),
    GRAZING_SLIDING: Kind(
        ("$g$", "k"), dash=(0, (3, 1)),
        parts=(
            "{name} just touches its surface {place}, and beyond is held there for a while",
            "{name} is no longer held {place}, and beyond does not come to its surface there",
        ),
    ),
    SWITCHING_SLIDING: Kind(
        ("$s$", "k"), dash=(0, (8, 1.5, 1, 1.5)),
        parts=(
            "{name} is held {place} at once, and beyond first passes and comes back",
            "{name} no longer passes and comes back {place}, and beyond is held there at once",
        ),
    ),
    ADDING_SLIDING: Kind(
        ("$a$", "k"), dash=(0, (8, 1.5)),
        parts=(
            "{name} is just held {place}, and beyond leaves its surface and comes back",
            "{name} no longer leaves its surface {place}, and beyond is held there throughout",
        ),
    ),
    CUSP: Kind(("v", "k"), on_curve="two curves of folds meet and end"),
    DEGENERATE: Kind(
        ("p", "w"),
        on_curve="beyond, the motions of twice the period begin on the other side",
    ),
    DEGENERATE_SYMMETRY: Kind(
        ("H", "w"), on_curve="beyond, the motions without symmetry begin on the other side"
    ),
    FLIP: Kind(
        (">", "w"),
        on_curve="multipliers 1 and -1: a curve of folds meets one of period doublings",
    ),
    RESONANCE_1: Kind(
        ("$1$", "k"), on_curve="a double multiplier 1: a curve of Neimark–Sacker points begins"
    ),
    RESONANCE_2: Kind(
        ("$2$", "k"), on_curve="a double multiplier -1: a curve of Neimark–Sacker points begins",
        multiplier=-1.0,
    ),
    RESONANCE_3: Kind(("$3$", "k"), on_curve="the angle of the multipliers is 2π/3"),
    RESONANCE_4: Kind(("$4$", "k"), on_curve="the angle of the multipliers is π/2"),
    RESONANT: Kind(("8", "w"), on_curve="a curve of folds and one of period doublings begin"),
}  # fmt: skip

# Kinds at which a part in which a switch is held vanishes or appears.
SLIDING = tuple(kind for kind, row in KINDS.items() if row.parts is not None)

# Kinds at which something is touched: by a flight, or by a body at the limit of being held.
TOUCHING = (GRAZING, REST, *SLIDING)

# Kinds that `boundary` follows in two parameters.
FOLLOWED = tuple(kind for kind, row in KINDS.items() if row.dash is not None)

# Functions for `Point.switch`: by the kind of the boundary (`None` for a branch) and that of the
# point, then by the kind of the result. The file `switch` registers them.
starts: dict[tuple[str | None, str], dict[str, Callable[[Any, float], Any]]] = {}


def with_article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"
