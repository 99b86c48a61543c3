"""What tables and pictures show of a branch, point by point."""

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from .._types import State, xr
from ..flow import average_names, in_names, quantities_on, quantity_names
from ..machine import AbstractMachine, components, with_units
from ._corrector import Step
from ._shooting import Shooting
from ._solution import sections_of
from .floquet import stability_of
from .results import Orbit

if TYPE_CHECKING:
    from .special import SpecialPoint

# What is a number at each point of every branch.
COLUMNS = (
    "parameter", "y_min", "y_max", "clearance", "frequency_ratio", "duration", "impacts",
    "fastest_impact", "slowest_impact", "multiplier", "stable",
)  # fmt: skip


def column_names(machine: AbstractMachine, like: State) -> tuple[str, ...]:
    """What is a number at each point of a branch of this machine, whose states are like this."""
    inner = (*components(like), *quantity_names(machine, like))
    return (*COLUMNS, *average_names(machine, like), *(f"section_{name}" for name in inner))


def on_sections(problem: Shooting, steps: list[Step]) -> dict[str, np.ndarray]:
    """State and quantities on the first section of each solution, by name; each (points,)."""
    rows = []
    for step in steps:
        states, _ = sections_of(problem, step.x)
        first = jax.tree.map(lambda x: x[:1], states)
        own = quantities_on(problem.at(jnp.asarray(step.x)), first)
        rows.append(components(first, 1) | own)
    return {name: np.concatenate([np.asarray(row[name]) for row in rows]) for name in rows[0]}


def stability_in_words(multipliers: np.ndarray) -> np.ndarray:
    """Of each point's multipliers, (points, states), the name of the verdict in `STABILITY`."""
    verdicts = jax.vmap(stability_of)(jnp.asarray(multipliers))
    return in_names(verdicts)


def point_of(special: "SpecialPoint", steps: list[Step]) -> int:
    """Which of a branch's points a special point is; -1 if it is none of them."""
    for i, step in enumerate(steps):
        if step.seen is special.step.seen:  # what is observed stays where conditions are left out
            return i
    if special.springs:  # its motion has half the period, but it is the branch's end
        return min((0, len(steps) - 1), key=lambda i: abs(steps[i].x[-1] - special.parameter))
    return -1


def special_table(special: list["SpecialPoint"], steps: list[Step]) -> dict[str, Any]:
    """Kind, place and extremes of each special point, as variables along `special`."""
    orbits = [point.orbit for point in special]
    # Without any the words are empty ones, whose type files can hold.
    found = {
        "kind": np.array([point.kind for point in special], str),
        "detail": np.array([point.detail for point in special], str),
        "parameter": np.array([point.parameter for point in special], float),
        "point": np.array([point_of(point, steps) for point in special], int),
        "cycles": np.array([int(orbit.cycles) for orbit in orbits], int),
        "y_min": np.array([float(orbit.y_min) for orbit in orbits], float),
        "y_max": np.array([float(orbit.y_max) for orbit in orbits], float),
    }
    return {f"special_{name}": ("special", x) for name, x in found.items()}


def table_of(
    function: Callable[[Orbit], Any],
    orbits: Iterable[Orbit],
    parameter: str,
    values: np.ndarray,
    units: Mapping[str, str],
) -> "xr.Dataset":
    """What a function makes of each orbit, as a data set over them (see `Branch.table`).

    **Arguments:** `parameter` and `values`, the name of the branch's parameter and its value for
    each orbit; `units`, the machine's.
    """
    if not callable(function):
        raise TypeError(
            f"Argument `function` must be a function of an `Orbit`, but got {function!r}."
        )
    rows = [_numbers(function(orbit)) for orbit in orbits]
    shapes = {name: x.shape for name, x in rows[0].items()}
    for i, row in enumerate(rows):
        here = {name: x.shape for name, x in row.items()}
        if here != shapes:
            raise TypeError(
                "Argument `function` must return numbers of the same names and shapes at each "
                f"point, but gave {shapes} at point 0 and {here} at point {i}."
            )
    if "parameter" in shapes:
        raise TypeError(
            "Argument `function` must call no number `parameter`, which is the branch's own."
        )
    data: dict[str, Any] = {name: ("point", values) for name in (parameter, "parameter")}
    for name, shape in shapes.items():
        axes = (f"{name}_{k}" for k in range(len(shape)))
        data[name] = ("point", *axes), np.stack([row[name] for row in rows])
    named = {name: name for name in (*shapes, parameter)} | {"parameter": parameter}
    return with_units(xr.Dataset(data, attrs={"parameter": parameter}), units, named)


def _numbers(found: object) -> dict[str, np.ndarray]:
    """Numbers by name, of what a function of an orbit returned."""
    named = found if isinstance(found, Mapping) else {"value": found}
    numbers = {str(name): np.asarray(x) for name, x in named.items()}
    for name, x in numbers.items():
        if x.dtype.kind not in "biufc":
            raise TypeError(
                "Argument `function` must return a number, or numbers by name, but its "
                f"{name!r} is {named[name]!r}."
            )
    return numbers
