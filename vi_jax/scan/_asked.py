"""What a scan is asked to measure: by name, by a measure, or by a function of one's own."""

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .measures import (
    AbstractMeasure,
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
    """A user's own function of one lane's scene and run."""

    function: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, scene, run):
        """What the function names of one lane, as arrays."""
        found = self.function(scene, run)
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


def measures_of(measure: Any) -> tuple[AbstractMeasure, ...]:
    """Measures by name, as objects, or functions of a scene and a run; one or several.

    **Raises:** `ValueError` for an unknown name, `TypeError` for anything else.
    """
    if isinstance(measure, str | AbstractMeasure) or callable(measure):
        measure = (measure,)
    if not isinstance(measure, Iterable):
        raise TypeError(f"Argument `measure` must be a name or a function, but got {measure!r}.")
    found = tuple(_measure(one) for one in measure)
    if not found:
        raise ValueError("Argument `measure` must name at least one measure, but is empty.")
    return found


def _measure(one: Any) -> AbstractMeasure:
    if isinstance(one, AbstractMeasure):
        return one
    if isinstance(one, str):
        if one in MEASURES:
            return MEASURES[one]()
        near = difflib.get_close_matches(one, MEASURES, n=2, cutoff=0.4) or list(MEASURES)
        raise ValueError(
            f"Argument `measure` must name a measure, but got {one!r}; near names: "
            f"{', '.join(near)}."
        )
    if callable(one):
        return Custom(one)
    raise TypeError(f"Argument `measure` must be a name or a function, but got {one!r}.")
