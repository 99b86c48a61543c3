"""How a run is made: the options of `simulate` as one object, which other verbs pass on."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from .._checks import count, count_or_traced, flag, one_of
from ..machine import AbstractMachine
from .methods import MethodLike, chosen

_NUMBERS = ["settle", "method", "begin", "until", "stop"]
_FIXED = [
    "clock", "samples", "impact_log", "event_log", "record", "rests", "max_impacts", "max_steps",
]  # fmt: skip


@functools.partial(jax.tree_util.register_dataclass, data_fields=_NUMBERS, meta_fields=_FIXED)
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RunOptions:
    """The options of a run, each as `simulate` describes it, with the same default.

    A pytree: `settle` and the numbers of `method` may be traced, so that others are not another
    program; all else is a part of the program.
    """

    settle: Any = 0
    method: MethodLike = None
    clock: str | None = None
    samples: int = 0
    impact_log: int = 0
    event_log: int = 0
    record: str = "motion"
    rests: bool | None = None
    max_impacts: int = 1000
    max_steps: int | None = None
    begin: Any = None
    """Clock of the start, where that is not on the section."""
    until: Any = None
    """The clock at which the one cycle of the run ends; the machine's own by default. Neither is
    for a machine whose cycles an event ends."""
    stop: Any = None
    """Ends a lane early, at a record point: `stop(machine, state, record, first)`, a flag, or
    `None` where it cannot tell; `first`, whether recording begins there. A pytree."""

    def checked(self, machine: AbstractMachine | None) -> "RunOptions":
        """The same options once each is known to be one, with the method that they choose.

        **Arguments:** the machine; `None` if it is not known yet.

        **Raises:** `TypeError` or `ValueError` that names the option.
        """
        most, counts = self.max_steps, ("samples", "impact_log", "event_log", "max_impacts")
        return dataclasses.replace(
            self,
            **{name: count(name, getattr(self, name)) for name in counts},
            method=chosen(machine, self.method),
            settle=count_or_traced("settle", self.settle),
            rests=None if self.rests is None else flag("rests", self.rests),
            max_steps=None if most is None else count("max_steps", most, least=1),
            record=one_of("record", self.record, ("motion", "sections")),
        )

    def check_limits(self, dtype: object) -> None:
        """**Raises:** `ValueError` for a limit beyond which numbers of this type do not count."""
        for name in ("max_impacts", "max_steps"):
            value = getattr(self, name)
            if value is not None and value > largest_count(dtype):
                raise ValueError(
                    f"Argument `{name}` must be at most {largest_count(dtype)}, up to which "
                    f"numbers of type {dtype} count, but got {value}."
                )


def largest_count(dtype: object) -> int:
    """The number up to which floating-point numbers of this type, in which the loop counts, do."""
    return round(2 / float(jnp.finfo(dtype).eps))
