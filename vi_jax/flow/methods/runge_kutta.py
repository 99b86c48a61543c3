"""Methods with steps of a diffrax Runge–Kutta solver, sized by their error or of fixed number."""

import sys
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from ..._checks import count, require
from ..._types import Scalar, State
from ...lanes import pin, weighted_sum
from ..sizes import unit_of
from ..smooth import TIME, Integrals, SmoothMachine, rate_of_integrals
from .base import AbstractMethod, Stage, has_relaxation
from .verner import Verner9

Vector = Float[Array, " n"]

# Newton's iterations until a stage fails, so that the step is repeated shorter: a choice.
_MAX_ITERATIONS = 12


def implicit_stages(
    tableau: Any,
    field: Callable[[Scalar, Vector], Vector],
    s0: Any,
    h: Any,
    y0: Vector,
    tolerance: Scalar | float,
    sizes: Vector,
) -> tuple[list[Vector], Scalar]:
    """Return the slopes of all stages of a step of length h from `y0`, flattened, and the last
    change by Newton's method.

    All stages share one matrix 1 - hγJ, with the Jacobian at the start of the step (Kværnø, BIT
    Numerical Mathematics 44, 2004). Each is solved to `tolerance` relative to `sizes` + |y|; if
    that fails, the returned change is infinite. Derivatives are those of the solution, by the
    implicit function theorem.
    """
    gamma = float(tableau.a_diagonal[-1])
    constants = stop_gradient((s0, y0))
    jacobian = jax.jacfwd(field, argnums=1)(*constants)
    inverse = inverse_of(jnp.eye(y0.size, dtype=y0.dtype) - stop_gradient(h) * gamma * jacobian)
    stages, last_change = [field(s0, y0)], jnp.zeros_like(h)
    for row, predictor, c in zip(tableau.a_lower, tableau.a_predictor, tableau.c, strict=True):
        base = y0 + h * weighted(row, stages)
        s = s0 + float(c) * h

        def residual(k: Vector, s: Scalar = s, base: Vector = base) -> Vector:
            return k - field(s, base + h * gamma * k)

        def solve(residual: Callable[[Vector], Vector], k: Vector) -> tuple[Vector, Scalar]:
            def goes_on(carry):
                _, size, i = carry
                return (size > tolerance) & (i < _MAX_ITERATIONS)

            def newton(carry):
                k, _, i = carry
                change = dot(inverse, residual(k))
                return k - change, change_of(h * gamma * change, y0, sizes), i + 1

            start = (k, jnp.full_like(h, jnp.inf), jnp.zeros_like(h))
            k, size, _ = jax.lax.while_loop(goes_on, newton, start)
            return k, jnp.where(size <= tolerance, size, jnp.inf)

        guess = stop_gradient(weighted(predictor, stages))
        k, size = jax.lax.custom_root(residual, guess, solve, _tangent, has_aux=True)
        stages.append(k)
        last_change = jnp.maximum(last_change, stop_gradient(size))
    return stages, last_change


def change_of(change: Vector, y: Vector, sizes: Vector) -> Scalar:
    """Return the largest component of a change relative to `sizes` + |y|; infinite for NaN."""
    size = jnp.max(jnp.abs(change) / (sizes + jnp.abs(y)))
    return jnp.where(jnp.isfinite(size), size, jnp.inf)


def weighted(weights: np.ndarray, stages: list, base: object = None) -> Any:
    """Return base + Σ weight·stage, leaf by leaf, without the zero weights."""
    used = [(w, x) for w, x in zip(weights, stages, strict=False) if w != 0]
    used, kept = zip(*used, strict=True)
    change = jtu.tree_map(lambda *leaves: weighted_sum(used, leaves), *kept)
    return change if base is None else jtu.tree_map(jnp.add, base, change)


def dot(matrix: Float[Array, "n n"], vector: Vector) -> Vector:
    """Return the product of a small matrix and a vector, as elementwise operations and a sum."""
    return jnp.sum(matrix * vector, axis=1)


def inverse_of(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return the inverse of a small matrix, by unrolled elimination with row pivots."""
    n = matrix.shape[0]
    rows = [jnp.concatenate([matrix[i], jnp.eye(n, dtype=matrix.dtype)[i]]) for i in range(n)]
    for i in range(n):
        for j in range(i + 1, n):  # the greatest pivot comes up
            swap = jnp.abs(rows[j][i]) > jnp.abs(rows[i][i])
            rows[i], rows[j] = jnp.where(swap, rows[j], rows[i]), jnp.where(swap, rows[i], rows[j])
        rows[i] = rows[i] / rows[i][i]
        for j in range(n):
            if j != i:
                rows[j] = rows[j] - rows[j][i] * rows[i]
    return jnp.stack([row[n:] for row in rows])


def _tangent(linear: Callable[[Vector], Vector], right: Vector) -> Vector:
    """Return the solution of a linear equation, from its function and right side, as `custom_root`
    needs for derivatives."""
    unit = jnp.eye(right.size, dtype=right.dtype)
    columns = jnp.stack([linear(unit[i]) for i in range(right.size)], axis=1)
    return dot(inverse_of(columns), right)


class UnrolledStages(eqx.Module):
    """The unrolled stages of an explicit or diagonally implicit Runge–Kutta solver. `vi.Unrolled`
    is the same as a diffrax solver. The split needs diffrax, which is slow to load, only for
    diffrax's own solvers."""

    solver: Any  # not checked to be a solver before `__check_init__`
    tolerance: Any = eqx.field(kw_only=True, default=None)
    sizes: Any = eqx.field(kw_only=True, default=None)

    def __check_init__(self):
        if not (isinstance(self.solver, Verner9) or _is_diffrax(self.solver, "ERK", "ESDIRK")):
            raise TypeError(
                "Argument `solver` must be an explicit or diagonally implicit diffrax Runge–Kutta "
                f"solver, but got {self.solver!r}."
            )

    @property
    def implicit(self) -> bool:
        """True if its stages are equations to be solved."""
        return _is_diffrax(self.solver, "ESDIRK")

    def order(self, terms):
        return self.solver.order(terms)

    def step_with_stages(self, terms, t0, t1, y0, args):
        """Return the end of a step over [t0, t1], its error, and the slopes of its stages; and for
        each stage its share of the step, t, y and weight in the error."""
        tableau = _tableau(self.solver)
        control = terms.contr(t0, t1)
        if self.implicit:
            return self._implicit(terms, t0, t1, y0, args, control)
        # The length comes last: once for each sum of slopes, where it is part of the addition.
        slopes, y1 = [terms.vf(t0, y0, args)], None
        places = [(0.0, t0, y0)]

        def advance(weights):
            return jtu.tree_map(jnp.add, y0, terms.prod(weighted(weights, slopes), control))

        for a, c in zip(tableau.a_lower, tableau.c, strict=True):
            y1 = advance(a)
            t = t1 if c == 1 else t0 + float(c) * (t1 - t0)
            places.append((float(c), t, y1))
            slopes.append(terms.vf(t, y1, args))
        if not tableau.ssal or y1 is None:
            y1 = advance(tableau.b_sol)
        error = terms.prod(weighted(tableau.b_error, slopes), control)
        return y1, error, slopes, _with_error_weights(tableau, places)

    def error(self, slopes: list[Any], control: Any) -> Any:
        """Return the error of a step from the slopes of its stages and its length."""
        change = weighted(_tableau(self.solver).b_error, slopes)
        return jtu.tree_map(lambda x: control * x, change)

    def _implicit(self, terms, t0, t1, y0, args, control):
        """Return a step with implicit stages; its error is infinite if one was not solved."""
        tableau = _tableau(self.solver)
        flat, unravel = ravel_pytree(y0)
        tolerance = 1e-12 if self.tolerance is None else self.tolerance

        def field(t, y):
            return ravel_pytree(terms.vf(t, unravel(y), args))[0]

        sizes = jtu.tree_map(jnp.ones_like, y0)
        if self.sizes is not None:
            sizes = jtu.tree_map(lambda one, size: one * size, sizes, self.sizes)
        scales = ravel_pytree(sizes)[0]
        slopes, change = implicit_stages(tableau, field, t0, control, flat, tolerance, scales)
        stages = [unravel(control * k) for k in slopes]
        error = weighted(tableau.b_error, stages)
        error = jtu.tree_map(lambda e, size: jnp.abs(e) + change * size, error, sizes)
        y1 = weighted(tableau.b_sol, stages, y0)
        assert tableau.a_diagonal is not None
        diagonal, places = tableau.a_diagonal[-1], [(0.0, t0, y0)]
        for n, (a, c) in enumerate(zip(tableau.a_lower, tableau.c, strict=True), start=2):
            y_stage = weighted(np.append(a, diagonal), stages[:n], y0)
            places.append((float(c), t0 + float(c) * (t1 - t0), y_stage))
        return y1, error, [unravel(k) for k in slopes], _with_error_weights(tableau, places)


def _is_diffrax(solver: object, *kinds: str) -> bool:
    """Return whether a solver is one of diffrax's. If diffrax is not loaded, it cannot be one."""
    diffrax: Any = sys.modules.get("diffrax")
    return diffrax is not None and isinstance(
        solver, tuple(getattr(diffrax, f"Abstract{kind}") for kind in kinds)
    )


class _Field(NamedTuple):
    """A vector field as a diffrax term."""

    vf: Callable[[Any, Any, Any], Any]

    def contr(self, t0, t1):
        return t1 - t0

    def prod(self, slope, control):
        return jtu.tree_map(lambda x: control * x, slope)


def _with_error_weights(tableau: Any, places: list[tuple]) -> list[tuple]:
    return [(*x, float(b)) for x, b in zip(places, tableau.b_error, strict=True)]


def _tableau(solver: Any) -> Any:
    tableau = solver.tableau
    if not hasattr(tableau, "b_sol"):
        raise TypeError(f"Argument `solver` must have one Butcher tableau, but got {solver!r}.")
    return tableau


# A fixed step is unstable if its error is larger than this share of the state, before it or after
# it. For x' = -a x, diffrax's explicit solvers have larger errors beyond their limit of stability:
# at least 0.46 (`Tsit5`).
_UNSTABLE = 0.4

# The tolerance of a guard that is no force. A choice: of 300 thresholds that move by three
# harmonics none was stepped over with this, and steps are twice as long as with 1e-9.
_VISIBLE = 1e-6


def _unrolled(solver: object) -> UnrolledStages:
    if isinstance(solver, Verner9):  # the default's program serves diffrax's class too
        solver = Verner9()
    return solver if isinstance(solver, UnrolledStages) else UnrolledStages(solver)


def _implicit_solver(
    solver: UnrolledStages, tolerance: Any, sizes: Any, beside: Integrals
) -> UnrolledStages:
    """Return an implicit solver for a state of these sizes, and for the integrals `beside` it."""
    if sizes is not None:
        sizes = sizes, jtu.tree_map(jnp.ones_like, beside)
    return UnrolledStages(solver.solver, tolerance=tolerance, sizes=sizes)


def _runge_kutta(solver: UnrolledStages, smooth: SmoothMachine, s0, s1, state, beside):
    """Return the results of a step of the solver: the state, the integrals `beside` it, the errors
    of both, the slopes at the stages, and the stages."""

    def field(s, y, args):
        state, beside = y
        return pin((smooth.field(s, state), rate_of_integrals(smooth, s, state, beside)))

    y1, error, slopes, places = solver.step_with_stages(
        _Field(field), s0, s1, (state, beside), None
    )
    return *y1, error, slopes, [Stage(c, s, y[0], weight) for c, s, y, weight in places]


def _sized_by(state: State, beside: Integrals) -> tuple[State, Integrals]:
    """Return the numbers that determine a step's size: state and integrals without elapsed time."""
    return state, {name: x for name, x in beside.items() if name != TIME}


def _size(state: State) -> Scalar:
    leaves = jtu.tree_leaves(jax.lax.stop_gradient(state))
    return jnp.asarray(sum(jnp.sum(jnp.abs(x)) for x in leaves))


def _as_array(x: Any) -> Any:
    return x if isinstance(x, Tracer) else np.asarray(x)


class _RungeKutta(AbstractMethod):
    """A method whose steps have stages."""

    def step(self, smooth, s0, s1, state, beside):
        return self.step_with_stages(smooth, s0, s1, state, beside)[:3]


class Adaptive(_RungeKutta):
    """A diffrax Runge–Kutta solver with steps sized by its error estimate.

    Use an implicit solver (`diffrax.Kvaerno5()`) for stiff machines, in which a part decays much
    faster than the rest moves, such as a strong motor. Its steps need not resolve that decay.

    **Arguments:** `solver` (default `Verner9()`, the fastest measured at 1e-7 and below);
    `rtol` and `atol`, tolerances relative to each state component and absolute; `atol` defaults to
    `rtol`, reduced in proportion for components that are smaller than 1; `steps_per_cycle`, the
    fewest steps in a cycle (at least 5, the default).

    **Raises:** `TypeError` if the solver is neither explicit nor diagonally implicit Runge–Kutta,
    `ValueError` for tolerances out of (0, 1], or fewer than 5 steps.
    """

    solver: UnrolledStages = eqx.field(default_factory=Verner9, converter=_unrolled)
    # Arrays, so that another tolerance does not compile again.
    rtol: Any = eqx.field(kw_only=True, default=1e-9, converter=_as_array)
    atol: Any = eqx.field(
        kw_only=True, default=None, converter=lambda x: x if x is None else _as_array(x)
    )
    steps_per_cycle: int = eqx.field(static=True, kw_only=True, default=5)  # pyright: ignore
    sizes: Any = eqx.field(kw_only=True, default=None, repr=False)
    """The sizes of the state's numbers, set by `with_sizes`."""

    def __check_init__(self):
        count("steps_per_cycle", self.steps_per_cycle, least=5)
        require("rtol", self.rtol, low=0.0, high=1.0, open_low=True)
        if self.atol is not None:
            require("atol", self.atol, low=0.0, high=1.0, open_low=True)

    @property
    def adaptive(self) -> bool:
        return True

    @property
    def wander(self):
        """The greater tolerance, since each step is sized anew."""
        return self.rtol if self.atol is None else jnp.maximum(self.rtol, self.atol)

    def with_sizes(self, sizes):
        return self if self.atol is not None else super().with_sizes(sizes)

    @property
    def is_limited_by_decay(self):
        """True for an explicit solver."""
        return not self.solver.implicit

    def step_with_stages(self, smooth, s0, s1, state, beside):
        """Return the results of one Runge–Kutta step, its error norm (root mean square over the
        components of the state and the integrals of averages), and its stages."""
        rtol, atol, floor = self.tolerances(s0)
        solver = self.solver
        if solver.implicit:
            solver = _implicit_solver(solver, jnp.maximum(0.01 * rtol, floor), self.sizes, beside)
        new, integrals, errors, _, stages = _runge_kutta(solver, smooth, s0, s1, state, beside)
        old, end, error = (_sized_by(*x) for x in ((state, beside), (new, integrals), errors))
        least = jtu.tree_map(lambda x: atol, old)
        if self.sizes is not None:
            least = jtu.tree_map(lambda size: atol * size, self.sizes), least[1]
        scaled = jtu.tree_map(
            lambda e, least, a, b: (e / (least + rtol * jnp.maximum(jnp.abs(a), jnp.abs(b)))) ** 2,
            error, least, old, end,
        )  # fmt: skip
        parts = jtu.tree_leaves(scaled)
        number = sum(x.size for x in parts)
        norm = jnp.sqrt(jax.lax.stop_gradient(sum(map(jnp.sum, parts)) / number))
        return new, integrals, norm, stages

    def tolerances(self, like: Scalar) -> tuple[Scalar, Scalar, float]:
        """Return rtol, atol and the floor of both, below which rounding would reject all steps."""
        floor = 8 * float(jnp.finfo(like.dtype).eps)
        rtol = jnp.maximum(jnp.asarray(self.rtol, like.dtype), floor)
        atol = rtol if self.atol is None else jnp.maximum(jnp.asarray(self.atol, like.dtype), floor)
        return rtol, atol, floor

    def guard_error(self, stages, values, h, longest, *, acts, size):
        """Return the error of a component whose rate is the guard, such as the impulse of a force
        that holds a body. A guard that is not such a force has the tolerance 1e-6."""
        rtol, atol, _ = self.tolerances(h)
        if not acts:
            rtol, atol = jnp.maximum(rtol, _VISIBLE), jnp.maximum(atol, _VISIBLE)
        values = jax.lax.stop_gradient(values)
        error = jnp.sum(np.asarray([x.weight for x in stages]) * values)
        atol = atol if isinstance(size, float) and size == 1.0 else atol * size
        return jnp.abs(h * error) / (atol + rtol * longest * jnp.max(jnp.abs(values)))

    def tighter(self):
        steps, atol = 2 * self.steps_per_cycle, None if self.atol is None else self.atol / 100
        return Adaptive(self.solver, rtol=self.rtol / 100, atol=atol, steps_per_cycle=steps)

    def resize(self, error):
        """Return 0.9 · error^(-1/order), between 0.2 and 5."""
        # A step length needs no double precision, and single precision powers vectorise.
        order = self.solver.order(None) or 1
        small = jnp.clip(error, 1e-20, 1e20).astype(jnp.float32)
        factor = 0.9 * small ** (-1.0 / order)
        return jnp.clip(factor, 0.2, 5.0).astype(error.dtype)


class FixedStep(_RungeKutta):
    """An explicit diffrax Runge–Kutta solver with a fixed number of steps in a cycle.

    It is faster under `vmap`, since no lane waits for another's rejected steps. A step that meets a
    stop is split there. The step is the smaller of cycle/n and natural period/n, so the error does
    not depend on ζ. Strong damping or a strong motor makes it shorter. Lanes of a machine that does
    not define its `relaxation` end as `unstable` at a step whose error is about as large as the
    state.

    **Arguments:** `solver` (default `Verner9()`), `steps_per_cycle` (at least 5, default 10;
    `preset` has its measured error).

    **Raises:** `TypeError` if the solver is not explicit Runge–Kutta, as the stages of an implicit
    one may have no solution in a step that cannot be shortened; `ValueError` for fewer than 5
    steps.
    """

    solver: UnrolledStages = eqx.field(default_factory=Verner9, converter=_unrolled)
    steps_per_cycle: int = eqx.field(static=True, default=10)  # pyright: ignore

    takes_implicit: ClassVar[bool] = False
    """True if the solver may be implicit."""

    def __check_init__(self):
        count("steps_per_cycle", self.steps_per_cycle, least=5)
        if self.solver.implicit and not self.takes_implicit:
            raise TypeError(
                "Argument `solver` of `FixedStep` must be an explicit diffrax Runge–Kutta solver, "
                f"but got {self.solver.solver!r}. Use `Adaptive`."
            )

    def may_be_unstable(self, machine, s, state):
        """Return whether the fastest decay of the machine is unknown."""
        return self.is_limited_by_decay and not has_relaxation(machine, s, state)

    def step_with_stages(self, smooth, s0, s1, state, beside):
        """Return the results of one Runge–Kutta step, whether it is unstable, and its stages."""
        new, integrals, _, slopes, stages = _runge_kutta(self.solver, smooth, s0, s1, state, beside)
        error = jnp.zeros_like(s0)
        if self.may_be_unstable(smooth.machine, s0, state):
            error = self._unstable(
                (state, new), [slope for slope, _ in slopes], s1 - s0, unit_of(smooth.machine)
            )
        return new, integrals, error, stages

    def _unstable(
        self, ends: tuple[State, State], slopes: list[State], h: Scalar, unit: Scalar | float
    ) -> Scalar:
        """Return a number above 1 if a step is unstable, else 0, from the state at both `ends` and
        its slopes at each stage; `unit` is `unit_of` the machine."""
        # For bodies at rest in zero only rounding is left.
        rounding = float(jnp.finfo(h.dtype).eps) ** 0.5
        before, after = (jnp.maximum(_size(x), rounding) for x in ends)
        # In other units of time rates are much larger, or smaller.
        if not (isinstance(unit, float) and unit == 1.0):
            after = jnp.maximum(after, jnp.where(unit == 1, 0.0, unit * _size(slopes[0])))

        def unstable(size, h, slopes):
            error = _size(self.solver.error(slopes, h))
            return jnp.where(error > _UNSTABLE * size, 2.0, jnp.zeros_like(h))

        # A step too short to change the state by its own size is stable without a test.
        values = jax.lax.stop_gradient((jnp.maximum(before, after), h, slopes))
        is_long = values[1] * _size(slopes[0]) > before
        return jax.lax.cond(is_long, unstable, lambda size, h, slopes: jnp.zeros_like(h), *values)

    def tighter(self):
        return FixedStep(self.solver, 2 * self.steps_per_cycle)


class ImplicitSteps(FixedStep):
    """An implicit solver with a fixed number of steps in a cycle, however fast the decay. It is
    used to follow the branch of a stiff machine. A step without a solution of its stages ends as
    NaN."""

    takes_implicit = True
    sizes: Any = eqx.field(kw_only=True, default=None, repr=False)
    """The sizes of the state's numbers, set by `with_sizes`."""

    @property
    def is_limited_by_decay(self):
        """False, as for `Adaptive` with such a solver."""
        return False

    def step_with_stages(self, smooth, s0, s1, state, beside):
        """Return the results of one Runge–Kutta step, an error of 0, and its stages."""
        solver = _implicit_solver(self.solver, 8 * jnp.finfo(s0.dtype).eps, self.sizes, beside)
        new, beside, errors, _, stages = _runge_kutta(solver, smooth, s0, s1, state, beside)
        solved = jnp.isfinite(sum(map(jnp.sum, jtu.tree_leaves(errors))))
        new = jtu.tree_map(lambda x: jnp.where(solved, x, jnp.nan), new)
        return new, beside, jnp.zeros_like(s0), stages

    def tighter(self):
        return ImplicitSteps(self.solver, 2 * self.steps_per_cycle)
