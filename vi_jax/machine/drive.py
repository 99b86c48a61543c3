"""What turns the crank. A drive owns its equations; here those of a drive of unlimited power."""

import abc
import dataclasses
from collections.abc import Iterable
from math import pi
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import POSITIVE, number, real, require, require_ranges
from .._types import State
from .shown import Shown
from .states import OscillatorState

# Why a drive has no such component, where there is more to say than that it has none.
_WITHOUT = {
    "W": "an ideal drive turns at its frequency ratio",
    "M": "only a `DCMotor` has a torque of its own",
}


class AbstractDrive(Shown):
    """The drive of the crank of a `Scene`.

    A subclass defines the motion of body and shaft (`field`) and the class of its states. Their
    components are `Y` and `V` of the body, then those of the drive: the crank speed `W` is one of
    them, unless `fixed_speed` returns it.
    """

    state: ClassVar[type]
    """Of its states, by crank angle."""
    timed_state: ClassVar[type | None] = None
    """By time, with the crank angle `phase` as one more component at the end; `None` where time
    itself tells the angle."""
    caption: ClassVar[str] = "drive"
    """What pictures write beside the crank."""

    @property
    def fixed_speed(self) -> Float[Array, "..."] | None:
        """The speed of the crank (unit: ω) where it is no part of the state."""
        return None

    @abc.abstractmethod
    def field(self, scene: Any, s: Any, state: State, pushes: Iterable[Any]) -> State:
        """d(state)/ds, by crank angle or, if `scene.clock_name` is `"time"`, by time τ.

        **Arguments:** the scene, for its `crank`, `phase_at` and `pull`; s, the state, and what
        compliant stops add to the body's acceleration.
        """

    def rate(self) -> Float[Array, "..."] | None:
        """The fastest rate, by τ, at which something in the drive fades; `None` if nothing does."""
        return None

    def usual(self, name: str, known: dict[str, Any]) -> Any:
        """A component of the drive's own where a start leaves it out; `known` are the components
        before it."""
        raise ValueError(
            f"Argument `{name}` of `start` must be given for a `{type(self).__name__}`, which has "
            "no `usual` for it."
        )

    def check(self) -> None:
        """**Raises:** `TypeError` for a drive that lacks what a scene asks of it."""
        kind, state = type(self), getattr(self, "state", None)
        if not isinstance(state, type):
            raise TypeError(
                f"Drive `{kind.__name__}` must say in `state` of which class its states are."
            )
        if self.fixed_speed is None and not isinstance(kind.timed_state, type):
            raise TypeError(
                f"Drive `{kind.__name__}` has the speed of the crank in its state, as it has no "
                "`fixed_speed`: it must say in `timed_state` of which class its states are by "
                "time, with the crank angle `phase` as their last component."
            )

    def begin(self, **given: Any) -> dict[str, Any]:
        """The drive's own components of a start, by name; what is not given, or `None`, is the
        `usual`.

        **Raises:** `ValueError` if a number is not finite, or no component of its state.
        """
        names = [part.name for part in dataclasses.fields(self.state)][2:]
        for name, value in given.items():
            if value is not None and name not in names:
                there = ["Y", "V", *names]
                near = [x for x in there if x.lower() == name.lower()]
                has = f"it is called `{near[0]}`" if near else f"a state has {', '.join(there)}"
                why = _WITHOUT.get(name, has)
                raise ValueError(
                    f"Argument `{name}` must be left out: {why}, but got {name}={value!r}."
                )
        found: dict[str, Any] = {}
        for name in names:
            value = given.get(name)
            found[name] = number(name, self.usual(name, found) if value is None else value)
            require(name, found[name])
        return found

    def speed(self, state: State) -> Float[Array, "..."]:
        """How fast the crank turns (unit: ω), without sign."""
        fixed = self.fixed_speed
        return jnp.abs(state.W) if fixed is None else fixed

    def duration(self) -> Float[Array, "..."] | float | None:
        """How long a turn takes (time τ), 2π/ζ; `None` where the speed is not fixed."""
        fixed = self.fixed_speed
        return None if fixed is None else 2 * pi / fixed


class IdealDrive(AbstractDrive):
    """A drive of unlimited power: the crank turns at a constant rate."""

    frequency_ratio: Float[Array, "..."] = eqx.field(converter=real("frequency_ratio"))
    """ζ = Ω/ω (dimensionless), positive."""
    ranges: ClassVar = {"frequency_ratio": POSITIVE}
    state: ClassVar = OscillatorState
    caption: ClassVar = "$\\varphi' = \\Omega$"

    def __check_init__(self):
        require_ranges(self)

    @property
    def fixed_speed(self):
        """ζ, the frequency ratio, at which an ideal drive turns under any load."""
        return self.frequency_ratio

    def field(self, scene, s, state, pushes):
        """d(state)/ds of the body alone, by crank angle (Eq. 8 of the paper) or by time (Eq. 5)."""
        zeta = self.frequency_ratio
        timed = scene.clock_name == "time"
        slide = scene.crank.slide(scene.phase_at(zeta * s if timed else s))
        pull = scene.pull(slide.U - state.Y, state.V, pushes)
        if timed:
            return OscillatorState(state.V, pull)
        return OscillatorState(state.V / zeta, pull / zeta)
