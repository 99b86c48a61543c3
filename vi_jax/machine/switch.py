"""A switch by the sign of a function."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient

from .._types import Machine, Scalar, Scalars, State
from .event import AbstractSwitch, Around
from .field import called, field_in, rate_of


class Switch(AbstractSwitch):
    """A mode that is the sign of a function: +1 where `function(machine, s, state)` is positive.

    At zero it is the sign of `rate(machine, s, state)`, the derivative of the function, if that is
    given, else +1.

    If the fields of both modes point at the surface on which the function vanishes, the motion
    cannot leave it. With `slides=True` it slides along (mode 0) by Filippov's rule: its field is
    the mean of the two, weighted between 0 and 1, that keeps the function at zero. It leaves when
    one of the two points away. Otherwise such a lane ends as `RESULTS.sliding`. The machine's field
    is never called with mode 0.
    """

    function: Callable[..., Any] = eqx.field(static=True)
    rate: Callable[..., Any] | None = eqx.field(static=True, default=None)
    slides: bool = eqx.field(static=True, default=False, kw_only=True)

    @property
    def may_slide(self) -> bool:
        """True if it has no mode for that."""
        return not self.slides

    @property
    def blends(self) -> bool:
        """Whether it slides: then mode 0 is the motion along its surface."""
        return self.slides

    @property
    def sees_around(self) -> bool:
        """True if it slides: the directions of both fields depend on the other modes."""
        return self.slides

    def begin(self, machine, s, state):
        """The sign of the function."""
        whose = f"The function of {self.name or 'a Switch'} of a {type(machine).__name__}"
        value = called(self.function, whose, machine, s, state)
        rate = jnp.ones_like(value) if self.rate is None else self.rate(machine, s, state)
        positive = (value > 0) | ((value == 0) & (rate >= 0))
        return jnp.where(positive, 1.0, -1.0).astype(value.dtype)

    def struck(self, machine, s, state, mode, *, around: Around | None = None):
        """The mode after an impact or another jump: the sign of the function; 0 on a surface that
        both fields point at."""
        side = self.begin(machine, s, state)
        if around is None:
            return side
        up, down = stop_gradient(self._rates(machine, s, state, around))
        rounding = 64 * float(jnp.finfo(up.dtype).eps) * (1 + jnp.abs(up) + jnp.abs(down))
        here = jnp.abs(stop_gradient(self.function(machine, s, state))) <= rounding
        return jnp.where(here & (up < 0) & (down > 0), 0.0, side)

    def guard(self, machine, s, state, mode, *, around: Around | None = None):
        """The function, falling from above or rising from below; while the motion slides, the rate
        of the field that points away first."""
        value = -mode * self.function(machine, s, state)
        if around is None:
            return value
        up, down = self._rates(machine, s, state, around)
        return jnp.where(mode == 0, jnp.maximum(up, -down), value)

    def sides(self, machine, s, state, mode, *, around: Around | None = None):
        """The guard; of a motion that slides the two of which it is the greater."""
        value = -mode * self.function(machine, s, state)
        if around is None:
            return (value,)
        up, down = self._rates(machine, s, state, around)
        return jnp.where(mode == 0, up, value), jnp.where(mode == 0, -down, value)

    def after(self, machine, s, state, mode, *, around: Around | None = None):
        """On the other side, or along the surface."""
        if around is None:
            return state, -mode
        up, down = self._rates(machine, s, state, around)
        slides = (mode != 0) & (up < 0) & (down > 0)
        leaves = jnp.where(up > -down, 1.0, -1.0)
        return state, jnp.where(slides, 0.0, jnp.where(mode == 0, leaves, -mode))

    def _rates(self, machine: Machine, s: Scalar, state: State, around: Around) -> Scalars:
        """d/ds of the function in the modes +1 and -1."""
        up, down = (field_in(machine, s, state, around.instead(mode)) for mode in (1.0, -1.0))
        return rate_of(self, machine, s, state, up), rate_of(self, machine, s, state, down)
