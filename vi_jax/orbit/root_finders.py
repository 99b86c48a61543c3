"""Root finders, `Newton` and `Gradient`, and the solution of equations with a neutral direction.

They are independent of orbits. `find.py` applies them, and differentiates the root with respect to
the numbers of the machine.
"""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from .._checks import count, instance_of, number, require
from .._types import Scalar
from ..lanes import call_numpy
from ..machine import Shown
from .linear import Matrix, solve, svd
from .tolerances import LOCATED, ROUNDING

# Above this singular value a motion is so unstable that rounding hides what is neutral: a choice.
_STEEP = 1e3


def rounding(dtype: object) -> float:
    """Return the share of the greatest singular value below which one is zero to rounding: 2e-12 in
    double and 6e-6 in single precision. If all are below it, so is the difference of the map's
    derivative from 1."""
    return float(jnp.finfo(dtype).eps) ** 0.75


def smallest_solution(matrix: Matrix, right_side: Array) -> Array:
    """Return the smallest solution of `matrix @ step = right_side`; `right_side - matrix @ step` is
    unreachable."""
    (more,) = call_numpy(_missing_images, [matrix.shape], stop_gradient(matrix))
    return solve(matrix + more, right_side)


def _missing_images(matrix: np.ndarray) -> list[np.ndarray]:
    """Return images of the directions without one, so that the matrix can be inverted."""
    left, sizes, right = svd(matrix)
    is_zero = sizes <= rounding(matrix.dtype) * np.clip(sizes[..., :1], 1.0, _STEEP)
    size = np.maximum(sizes[..., :1], 1.0)
    return [(left * (is_zero * size)[..., None, :]) @ right]


Unknowns = Float[Array, "..."]
Residual = Callable[[Unknowns], Unknowns]


class AbstractRootFinder(Shown):
    """An iteration towards a zero of a residual, used by `find_root`."""

    tolerance: eqx.AbstractVar[Any]
    max_steps: eqx.AbstractVar[int]
    arcs: eqx.AbstractVar[int]
    usual_tolerance: ClassVar[float]
    """The tolerance in double precision, if none is given."""

    def __check_init__(self):
        if self.tolerance is not None:
            require("tolerance", self.tolerance, low=0.0, open_low=True)
        count("max_steps", self.max_steps, least=1)
        count("arcs", self.arcs, least=1)

    @abc.abstractmethod
    def init(self, residual: Residual, x: Unknowns) -> Any:
        """Return the memory with which `step` begins, any pytree."""

    @abc.abstractmethod
    def step(
        self, residual: Residual, x: Unknowns, memory: Any
    ) -> tuple[Unknowns, Any, Unknowns, Scalar]:
        """Make one step from `x`.

        **Returns:** the next place; the memory; a place with known residual, and the largest
        component of that residual.
        """


def _tolerance(value: Any) -> Any:
    return None if value is None else number("tolerance", value)


class Newton(AbstractRootFinder):
    """Newton's method, damped by a trust region (Powell's dogleg): quadratic near the orbit.

    **Arguments:**

    - `tolerance`: largest residual component of a found orbit, relative to the sizes of the
      components of its state; by default 1e-10 in double and 1e-4 in single precision, for each
      cycle of the period. The search continues below it as long as the residual decreases.
    - `max_steps`: maximum number of steps; static.
    - `arcs`: 1 for single shooting. With more, the period is divided into that many arcs, whose
      first states are all unknowns (multiple shooting): for motions that amplify perturbations too
      much within one period. Must divide the cycles; static.
    """

    tolerance: Any = eqx.field(kw_only=True, default=None, converter=_tolerance)
    max_steps: int = eqx.field(kw_only=True, static=True, default=50)
    arcs: int = eqx.field(kw_only=True, static=True, default=1)
    usual_tolerance: ClassVar[float] = 1e-10

    def init(self, residual, x):
        """Return the first memory. The first step accepts its trial in any case."""
        nothing, one = jnp.zeros_like(x), jnp.ones((), x.dtype)
        jacobian = jnp.zeros((x.size, x.size), x.dtype)
        return _Dogleg(x, nothing, jacobian, one, jnp.ones((), bool))

    def step(self, residual, x, memory):
        """Try one dogleg step; the place moves only if the residual falls."""
        trial, old, radius = memory.trial, memory.residual, memory.radius
        new, jacobian = _with_jacobian(residual, trial)
        predicted = old.ravel() + memory.jacobian @ (trial - x).ravel()
        foreseen = 0.5 * (jnp.sum(predicted**2) - jnp.sum(old**2))
        change = 0.5 * jnp.sum(new**2) - 0.5 * jnp.sum(old**2)
        accepted = (change <= _POOR * foreseen) | memory.is_first
        good = (change < _GOOD * foreseen) & (foreseen < 0) & ~memory.is_first
        radius = radius * jnp.where(accepted, jnp.where(good, _LONGER, 1.0), _SHORTER)
        x, new = jnp.where(accepted, trial, x), jnp.where(accepted, new, old)
        jacobian = jnp.where(accepted, jacobian, memory.jacobian)
        (move,) = call_numpy(_dogleg, [(x.size,)], jacobian, new.ravel(), radius)
        move = move.reshape(x.shape)
        memory = _Dogleg(x + move, new, jacobian, radius, jnp.zeros((), bool))
        return x, memory, x, _largest(new)


class _Dogleg(NamedTuple):
    """The memory of `Newton`."""

    trial: Unknowns
    residual: Unknowns
    """At the place, as the Jacobian."""
    jacobian: Matrix
    radius: Scalar
    """Of the trust region, over the length of Newton's step."""
    is_first: Array


# Gould, Orban, Sartenaer and Toint (Sensitivity of trust-region algorithms to their parameters,
# 2005): the share of the foreseen change of the residual below which a trial is refused, and above
# which the radius grows; the factors of the radius.
_POOR, _GOOD, _LONGER, _SHORTER = 0.01, 0.99, 3.5, 0.25


def _with_jacobian(residual: Residual, x: Unknowns) -> tuple[Unknowns, Matrix]:
    def along(direction):
        return jax.jvp(residual, (x,), (direction.reshape(x.shape),))

    values, columns = jax.vmap(along, out_axes=(0, -1))(jnp.eye(x.size, dtype=x.dtype))
    return values[0], columns.reshape(x.size, x.size)


def _dogleg(jacobian: np.ndarray, residual: np.ndarray, radius: np.ndarray) -> list[np.ndarray]:
    """Return the step on the path from here over the least point along the gradient to Newton's
    point, at the `radius` over the length of Newton's step (Nocedal and Wright, 4.1). Arrays may
    have batch axes first."""
    inner = lambda a, b: np.sum(a * b, axis=-1, keepdims=True)
    newton = _newton_step(jacobian, residual)
    gradient = np.einsum("...i,...ij->...j", residual, jacobian)
    image = np.einsum("...ij,...j->...i", jacobian, gradient)
    curvature, eps = inner(image, image), np.finfo(jacobian.dtype).eps
    share = np.where(curvature > eps, inner(gradient, gradient) / np.maximum(curvature, eps), 0.0)
    cauchy, radius = -gradient * share, radius[..., None]
    length, reach = np.sqrt(inner(cauchy, cauchy)), radius * np.sqrt(inner(newton, newton))
    shorter = cauchy * np.where(length > eps, reach / np.maximum(length, eps), 0.0)
    # |cauchy + t (newton - cauchy)| = reach, by the stable one of two formulas for the root.
    leg = newton - cauchy
    a, half_b, c = inner(leg, leg), inner(cauchy, leg), length**2 - reach**2
    with np.errstate(all="ignore"):
        root = np.sqrt(half_b**2 - a * c)
        t = np.where(half_b > 0, -c / (half_b + root), (root - half_b) / a)
    between = cauchy + np.clip(t, 0.0, 1.0) * leg
    return [np.where(length > reach, shorter, np.where(radius < 1, between, newton))]


def _newton_step(jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return Newton's step; if a direction is neutral, the smallest of all steps."""
    try:  # the inverse takes a tenth of the time of singular values
        inverse = np.linalg.inv(jacobian)
    except np.linalg.LinAlgError:
        inverse = np.full_like(jacobian, np.nan)
    step = -np.einsum("...ij,...j->...i", inverse, residual)
    size = np.maximum(np.linalg.norm(jacobian, axis=(-2, -1)), 1.0)
    doubtful = ~(size * np.linalg.norm(inverse, axis=(-2, -1)) < 0.1 / rounding(jacobian.dtype))
    if doubtful.any():
        left, values, right = svd(jacobian[doubtful])
        reachable = values > rounding(jacobian.dtype) * np.maximum(values[:, :1], 1.0)
        parts = np.einsum("ni,nij->nj", residual[doubtful], left)
        parts = np.where(reachable, parts / np.where(reachable, values, 1.0), 0.0)
        step[doubtful] = -np.einsum("ni,nij->nj", parts, right)
    return step


class Gradient(AbstractRootFinder):
    """Descent on half the squared residual with an optax optimiser.

    **Arguments:**

    - `optimiser`: an `optax.GradientTransformation`; by default Adam, with a rate that falls along
      a cosine from 0.02 to zero over `max_steps`.
    - `tolerance`: as for `Newton`; by default 1e-7 in double and 1e-4 in single precision.
    - `max_steps`: maximum number of steps; static.
    - `arcs`: as for `Newton`.
    """

    optimiser: Any = eqx.field(static=True, default=None)
    tolerance: Any = eqx.field(kw_only=True, default=None, converter=_tolerance)
    max_steps: int = eqx.field(kw_only=True, static=True, default=1000)
    arcs: int = eqx.field(kw_only=True, static=True, default=1)
    usual_tolerance: ClassVar[float] = 1e-7

    def __check_init__(self):
        if self.optimiser is not None:
            import optax  # slow to load

            wanted = "an `optax.GradientTransformation`, such as `optax.adam(0.01)`"
            instance_of("optimiser", self.optimiser, optax.GradientTransformation, wanted)

    @property
    def _optimiser(self) -> Any:
        import optax  # slow to load

        if self.optimiser is not None:
            return self.optimiser
        return optax.adam(optax.cosine_decay_schedule(0.02, self.max_steps))

    def init(self, residual, x):
        """Return the first memory, the optimiser's state."""
        return self._optimiser.init(x)

    def step(self, residual, x, memory):
        """Make one step of the optimiser; the returned residual is that at its start."""

        def loss(x):
            values = residual(x)
            return 0.5 * jnp.sum(values**2), values

        gradient, values = jax.grad(loss, has_aux=True)(x)
        update, memory = self._optimiser.update(gradient, memory, x)
        return x + update, memory, x, _largest(values)


def _largest(values: Array) -> Array:
    # A NaN must win; `max` does not guarantee this on every backend.
    return jnp.where(jnp.all(jnp.isfinite(values)), jnp.max(jnp.abs(values)), jnp.nan)


class Found(NamedTuple):
    """The result of a root finder."""

    x: Unknowns
    """The place with the smallest residual of the search."""
    residual: Scalar
    """Largest component of the residual at `x`."""
    converged: Array
    """Nonzero if the residual is within its tolerance."""
    steps: Array
    """Number of steps of the search."""
    history: Float[Array, " max_steps"]
    """Largest residual component after each step, NaN beyond the last."""
    unit: Scalar
    """The unit of the tolerance: the largest unknown, or 1 at rest."""


# A residual above this share of that of the guess is not one of a root: a choice. Close to a
# resonance, roots of a million times the size of that residual have smaller ones.
_DECREASE = 1e-3


def find_root(
    root_finder: AbstractRootFinder, residual: Residual, x: Unknowns, cycles: int = 1
) -> Found:
    """Run a root finder from `x` until the residual is within its tolerance and decreases no more.
    The usual tolerance is for each of the `cycles` over which a residual sums the steps' errors.

    A place with a residual that is not finite is never better than another.
    """
    tolerance = root_finder.tolerance
    if tolerance is None:
        usual = root_finder.usual_tolerance if x.dtype == jnp.float64 else 1e-4
        tolerance = usual * cycles
    nan, guess = jnp.full((), jnp.nan, x.dtype), x

    def unit(place):
        # A motion that comes to rest in the origin has no size to be relative to.
        size = jnp.max(jnp.maximum(jnp.abs(place), LOCATED * jnp.abs(guess)))
        return jnp.where(size > ROUNDING, size, 1.0)

    memory, static = eqx.partition(root_finder.init(residual, x), eqx.is_array)
    history = jnp.full((root_finder.max_steps,), jnp.nan, x.dtype)

    def continues(carry):
        _, _, best, size, last, steps, _ = carry
        # Newton's last steps from the tolerance to rounding are worth their cost.
        decreases = ~(size > 0.1 * last) & (size > 0)
        hopeless = (steps > 0) & jnp.isnan(size)
        done = hopeless | ((size <= tolerance * unit(best)) & ~decreases)
        return ~done & (steps < root_finder.max_steps)

    def body(carry):
        x, memory, best, size, _, steps, history = carry
        x, memory, place, size_here = root_finder.step(residual, x, eqx.combine(memory, static))
        better = ~jnp.isnan(size_here) & ~(size_here >= size)
        best, smallest = jnp.where(better, place, best), jnp.where(better, size_here, size)
        history = history.at[steps].set(size_here)
        return x, eqx.filter(memory, eqx.is_array), best, smallest, size, steps + 1, history

    carry = (x, memory, x, nan, nan, jnp.zeros((), jnp.int32), history)
    _, _, best, size, _, steps, history = jax.lax.while_loop(continues, body, carry)
    # Without a root, as at a resonance without damping, places far away make a residual small only
    # relative to themselves.
    smaller = (size <= tolerance * unit(guess)) | (size <= _DECREASE * history[0])
    converged = (size <= tolerance * unit(best)) & smaller
    return Found(best, size, converged, steps, history, unit(best))
