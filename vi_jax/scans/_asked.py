"""What a scan is asked to measure: by name, by a measure, or by a function of one's own."""

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._checks import count
from .measures import (
    AbstractMeasure,
    Average,
    Exponent,
    Extremes,
    FrequencyRatio,
    ImpactRate,
    Power,
    Regime,
    Sections,
    Steps,
)


class Custom(AbstractMeasure):
    """A user's own function of one lane's machine and run."""

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, machine, run):
        """What the function names of one lane, as arrays."""
        found = self.function(machine, run)
        if not isinstance(found, Mapping):
            raise TypeError(
                "A function in argument `measure` must return a mapping of names to numbers, but "
                f"returned {type(found).__name__}."
            )
        numbers = {}
        for name, value in found.items():
            try:
                numbers[name] = jnp.asarray(value)
            except (TypeError, ValueError):
                raise TypeError(
                    "A function in argument `measure` must return numbers, but its "
                    f"{name!r} is {value!r}."
                ) from None
        return numbers


MEASURES: Mapping[str, Callable[[], AbstractMeasure]] = {
    "extremes": Extremes,
    "regime": Regime,
    "frequency_ratio": FrequencyRatio,
    "power": Power,
    "impact_rate": ImpactRate,
    "sections": Sections,
    "exponent": Exponent,
    "steps": Steps,
}


def measures_of(measure: object, averages: Sequence[str] = ()) -> tuple[AbstractMeasure, ...]:
    """Measures by name, as objects, or functions of a machine and a run; one or several. A name may
    be that of one of the machine's own `averages`, which comes first.

    **Raises:** `ValueError` for an unknown name, `TypeError` for anything else.
    """
    if isinstance(measure, str | AbstractMeasure) or callable(measure):
        measure = (measure,)
    if not isinstance(measure, Iterable):
        raise TypeError(f"Argument `measure` must be a name or a function, but got {measure!r}.")
    found = tuple(_measure(one, averages) for one in measure)
    if not found:
        raise ValueError("Argument `measure` must name at least one measure, but is empty.")
    return found


def _measure(one: object, averages: Sequence[str]) -> AbstractMeasure:
    if isinstance(one, AbstractMeasure):
        return one
    if isinstance(one, str):
        if one in averages:
            return Average(one)
        if one in MEASURES:
            return MEASURES[one]()
        names = [*averages, *MEASURES]
        near = difflib.get_close_matches(one, names, n=2, cutoff=0.6)
        hint = f"near names: {', '.join(near)}" if near else f"there are: {', '.join(names)}"
        raise ValueError(f"Argument `measure` must name a measure, but got {one!r}; {hint}.")
    if callable(one):
        return Custom(one)
    raise TypeError(f"Argument `measure` must be a name or a function, but got {one!r}.")


def cycles_for(measures: Iterable[AbstractMeasure], cycles: int | None) -> int:
    """The cycles to observe: those asked for, or as many as these measures need.

    **Raises:** `ValueError` if they are too few for one of them.
    """
    needed = max(m.cycles for m in measures)
    cycles = max(32, needed) if cycles is None else count("cycles", cycles, least=1)
    if cycles < needed:
        who = next(type(m).__name__ for m in measures if m.cycles > cycles)
        raise ValueError(
            f"Argument `cycles` must be at least {needed} for the measure {who}, but got {cycles}."
        )
    return cycles


def samples_for(measures: Iterable[AbstractMeasure]) -> int:
    """Samples in a cycle. **Raises:** `ValueError` for measures that ask for different ones."""
    asked = {m.instants for m in measures if m.instants}
    if len(asked) > 1:
        raise ValueError(
            f"Argument `measure` must ask for one number of samples, but asks for {sorted(asked)}."
        )
    return max(asked, default=0)
