"""Contact laws: the force with which a compliant stop answers a depth and its rate."""

import abc
from math import pi, sqrt
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._checks import require
from .shown import Shown


class AbstractContactLaw(Shown):
    """Force away from a `SoftStop` by the depth δ > 0 and its rate δ'.

    A subclass defines `force`. It may use the stiffness K and the damping α of the stop, or
    parameters of the law.
    """

    exponent: float = eqx.field(static=True, default=1.0, converter=float)
    """p, the power of the depth in the spring's force, at least 1; the step length depends on it.
    Static."""

    def __check_init__(self):
        require("exponent", self.exponent, low=1.0)

    @property
    def is_analytic(self) -> bool:
        """Whether the force has a power series at first touch."""
        return self.exponent == 1

    @abc.abstractmethod
    def force(self, stiffness: Any, damping: Any, depth: Any, rate: Any) -> Any:
        """The force away from the stop on a body that touches, without prestress; it may pull (be
        negative)."""

    def pulls(self, stiffness: Any, damping: Any, prestress: Any, depth: Any, rate: Any) -> Any:
        """A function with the sign of the pull: positive where the stop would pull the body. It
        ends a contact that may not pull, and should be smooth at first touch.

        **Arguments:** `stiffness` K and `damping` α; `prestress` F0, or `None`; `depth` δ and its
        `rate` δ' with respect to time.
        """
        force = self.force(stiffness, damping, depth, rate)
        return -force if prestress is None else -(prestress + force)

    def damping_of(self, restitution: Any) -> Any:
        """α that gives this restitution at every speed; `None` for a law whose restitution depends
        on it."""
        return None

    def frequency(self, stiffness: Any, depth: Any, rate: Any) -> Any:
        """The frequency with which a body oscillates on the stop, at the depth that it will
        reach; `stiffness` is that per unit of its mass."""
        p, deepest = self.exponent, jnp.maximum(depth, 1e-12)
        if p > 1:
            reach = (0.5 * (p + 1) * rate**2 / stiffness + 1e-30) ** (1 / (p + 1))
            deepest = jnp.maximum(deepest, reach)
        return jnp.sqrt(p * stiffness * power(deepest, p - 1))


class PowerLaw(AbstractContactLaw):
    """K δᵖ + α √K δ^((p-1)/2) δ': p = 1 is a spring with a dashpot, p = 3/2 Hertz's contact.

    Its coefficient of restitution does not depend on the speed,
    α = √(2(p+1)) (-ln e)/√(π² + ln² e) (Feng, arXiv 2603.27764).
    """

    def force(self, stiffness, damping, depth, rate):
        """K δ^p of the spring and α √K δ^((p-1)/2) δ' of the dashpot; on a body of another mass
        than 1 the stop gives α √m for α."""
        p = self.exponent
        resist = damping * jnp.sqrt(stiffness) * power(depth, 0.5 * (p - 1)) * rate
        return stiffness * power(depth, p) + resist

    def pulls(self, stiffness, damping, prestress, depth, rate):
        """The pull over δ^((p-1)/2), which is smooth at first touch."""
        root = power(depth, 0.5 * (self.exponent + 1))
        pull = -stiffness * root - damping * jnp.sqrt(stiffness) * rate
        flat = power(depth, 0.5 * (self.exponent - 1))
        return pull if prestress is None else pull * flat - prestress

    def damping_of(self, restitution):
        """α from e in (0, 1]."""
        require("restitution", restitution, low=0.0, high=1.0, open_low=True)
        drop = -jnp.log(jnp.asarray(restitution, float))
        return sqrt(2 * (self.exponent + 1)) * drop / jnp.sqrt(pi**2 + drop**2)


class HuntCrossley(AbstractContactLaw):
    """K δᵖ (1 + α δ'), whose restitution falls with the speed."""

    def force(self, stiffness, damping, depth, rate):
        """The spring's force with a damping in proportion to it."""
        spring = stiffness * power(depth, self.exponent)
        return spring + damping * spring * rate

    def pulls(self, stiffness, damping, prestress, depth, rate):
        """The pull over the spring's force, without prestress: that vanishes at first touch."""
        if prestress is None:
            return -(1 + damping * rate)
        return super().pulls(stiffness, damping, prestress, depth, rate)


def power(x: Any, n: float) -> Any:
    """xⁿ inside; for n = 0 and 1 continued smoothly to where a step may look beyond the surface."""
    if n == 0:
        return jnp.ones_like(x)
    if n == 1:
        return x
    inside = x > 0
    return jnp.where(inside, jnp.where(inside, x, 1.0) ** n, 0.0)
