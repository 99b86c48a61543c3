"""Steps by a diffrax Runge–Kutta solver, sized by its error or of fixed number."""

import dataclasses
import functools
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

from ..._checks import count, require
from ..._types import Scalar, State
from ...lanes import pin
from ..integrals import TIME, Integrals, rate_of_integrals
from ..smooth import SmoothMachine, unit_of
from .base import AbstractMethod, Stage, fading_is_known
from .unrolled import Unrolled
from .verner import Verner9

# A fixed step is unstable if its error is larger than this share of the state, before it or after
# it. Of x' = -a x that of each of diffrax's explicit solvers is, from the limit of stability on: at
# least 0.46 (`Tsit5`).
_UNSTABLE = 0.4

# How well a guard has to be known that acts on nothing. A choice: of 300 thresholds that move by
# three harmonics none was stepped over with this, and steps are twice as long as with 1e-9.
_VISIBLE = 1e-6


def _unrolled(solver: object) -> Unrolled:
    return solver if isinstance(solver, Unrolled) else Unrolled(solver)


def _runge_kutta(solver: Unrolled, smooth: SmoothMachine, s0, s1, state, beside):
    """Return what a step of the solver leads to: the state, what is integrated `beside` it, the
    errors of both, the slopes at the stages, and these."""

    def field(s, y, args):
        state, beside = y
        return pin((smooth.field(s, state), rate_of_integrals(smooth, s, state, beside)))

    y1, error, slopes, places = solver.step_with_stages(
        diffrax.ODETerm(field), s0, s1, (state, beside), None
    )
    return *y1, error, slopes, [Stage(c, s, y[0], weight) for c, s, y, weight in places]


def _sized_by(state: State, beside: Integrals) -> tuple[State, Integrals]:
    """What the size of a step is chosen by: the state and the integrals, but not the elapsed
    time."""
    return state, {name: x for name, x in beside.items() if name != TIME}


def _size(state: State) -> Scalar:
    leaves = jtu.tree_leaves(jax.lax.stop_gradient(state))
    return jnp.asarray(sum(jnp.sum(jnp.abs(x)) for x in leaves))


def _number(x: Any) -> Any:
    return x if isinstance(x, Tracer) else np.asarray(x)


def _number_or_none(x: Any) -> Any:
    return None if x is None else _number(x)


class _RungeKutta(AbstractMethod):
    """A method whose steps have stages."""

    def step(self, smooth, s0, s1, state, beside):
        """One Runge–Kutta step, and its error."""
        return self.step_with_stages(smooth, s0, s1, state, beside)[:3]


class Adaptive(_RungeKutta):
    """A diffrax Runge–Kutta solver with steps sized by its error estimate.

    An implicit one (`diffrax.Kvaerno5()`) is for machines of which a part fades much faster than
    the rest moves, such as a strong motor: its steps need not follow what has faded.

    **Arguments:** `solver` (default `Verner9()`, the fastest measured from 1e-7 on); `rtol` and
    `atol`, tolerances relative to each state component and absolute; `atol` defaults to `rtol`,
    reduced in proportion for components that are smaller than 0.01 at the start (a machine in SI
    units); `steps_per_cycle`, the fewest steps in a cycle (at least 5, the default).

    **Raises:** `TypeError` if the solver is neither explicit nor diagonally implicit Runge–Kutta,
    `ValueError` for tolerances out of (0, 1], or fewer than 5 steps.
    """

    solver: Unrolled = eqx.field(default_factory=Verner9, converter=_unrolled)
    # Arrays, so that another tolerance is not another program.
    rtol: Any = eqx.field(kw_only=True, default=1e-9, converter=_number)
    atol: Any = eqx.field(kw_only=True, default=None, converter=_number_or_none)
    steps_per_cycle: int = eqx.field(static=True, kw_only=True, default=5)  # pyright: ignore
    sizes: Any = eqx.field(kw_only=True, default=None, repr=False)
    """How large the numbers of the state are, as `with_sizes` sets it."""

    def __check_init__(self):
        count("steps_per_cycle", self.steps_per_cycle, least=5)
        require("rtol", self.rtol, low=0.0, high=1.0, open_low=True)
        if self.atol is not None:
            require("atol", self.atol, low=0.0, high=1.0, open_low=True)

    @property
    def adaptive(self) -> bool:
        """True: steps are resized by their errors."""
        return True

    @property
    def wander(self):
        """Within the tolerances, by which each step is sized anew."""
        return self.rtol if self.atol is None else jnp.maximum(self.rtol, self.atol)

    def with_sizes(self, sizes):
        """With errors judged by these sizes, unless an absolute tolerance is given."""
        return self if self.atol is not None else dataclasses.replace(self, sizes=sizes)

    @property
    def follows_fading(self):
        """Not with an implicit solver."""
        return not self.solver.implicit

    def step_with_stages(self, smooth, s0, s1, state, beside):
        """One Runge–Kutta step, its error norm (root mean square over the components of the state
        and the integrals of averages), and its stages."""
        rtol, atol, floor = self._tolerances(s0)
        solver = self.solver
        if solver.implicit:
            solver = Unrolled(solver.solver, tolerance=jnp.maximum(0.01 * rtol, floor))
        new, after, errors, _, stages = _runge_kutta(solver, smooth, s0, s1, state, beside)
        old, there, error = (_sized_by(*x) for x in ((state, beside), (new, after), errors))
        least = jtu.tree_map(lambda x: atol, old)
        if self.sizes is not None:
            least = jtu.tree_map(lambda size: atol * size, self.sizes), least[1]
        scaled = jtu.tree_map(
            lambda e, least, a, b: (e / (least + rtol * jnp.maximum(jnp.abs(a), jnp.abs(b)))) ** 2,
            error, least, old, there,
        )  # fmt: skip
        parts = jtu.tree_leaves(scaled)
        number = sum(x.size for x in parts)
        norm = jnp.sqrt(jax.lax.stop_gradient(sum(map(jnp.sum, parts)) / number))
        return new, after, norm, stages

    def _tolerances(self, like: Scalar) -> tuple[Scalar, Scalar, float]:
        """Return rtol, atol and the smallest value of both: below rounding a tolerance would only
        be rejected for ever."""
        floor = 8 * float(jnp.finfo(like.dtype).eps)
        rtol = jnp.maximum(jnp.asarray(self.rtol, like.dtype), floor)
        atol = rtol if self.atol is None else jnp.maximum(jnp.asarray(self.atol, like.dtype), floor)
        return rtol, atol, floor

    def guard_error(self, stages, values, h, longest, *, acts, size):
        """The error of a component whose rate is the guard, such as the impulse of a force that
        holds a body. A guard that is not such a force has the tolerance 1e-6."""
        rtol, atol, _ = self._tolerances(h)
        if not acts:
            rtol, atol = jnp.maximum(rtol, _VISIBLE), jnp.maximum(atol, _VISIBLE)
        values = jax.lax.stop_gradient(values)
        error = jnp.sum(np.asarray([x.weight for x in stages]) * values)
        atol = atol if isinstance(size, float) else atol * size
        if self.sizes is not None:
            atol = atol * functools.reduce(jnp.maximum, jtu.tree_leaves(self.sizes))
        return jnp.abs(h * error) / (atol + rtol * longest * jnp.max(jnp.abs(values)))

    def tighter(self):
        """A hundredth of the tolerances, and steps at most half as long."""
        steps, atol = 2 * self.steps_per_cycle, None if self.atol is None else self.atol / 100
        return Adaptive(self.solver, rtol=self.rtol / 100, atol=atol, steps_per_cycle=steps)

    def resize(self, error):
        """0.9 · error^(-1/order), between 0.2 and 5."""
        # A step length needs no double precision, and single precision powers vectorise.
        order = self.solver.order(None) or 1
        small = jnp.clip(error, 1e-20, 1e20).astype(jnp.float32)
        factor = 0.9 * small ** (-1.0 / order)
        return jnp.clip(factor, 0.2, 5.0).astype(error.dtype)


class FixedStep(_RungeKutta):
    """An explicit diffrax Runge–Kutta solver with a fixed number of steps in a cycle.

    Under `vmap` this is the faster choice: no lane waits for another's rejected steps. A step that
    meets a stop is split there. The step is the smaller of a share of the drive cycle and of a
    natural period of the body, so the error does not depend on ζ. Strong damping or a strong motor
    makes it shorter. Lanes of a machine that does not define its `relaxation` end as `unstable` at
    a step whose error is about as large as the state.

    **Arguments:** `solver` (default `Verner9()`), `steps_per_cycle` (at least 5, default 10;
    `preset` has its measured error).

    **Raises:** `TypeError` if the solver is not explicit Runge–Kutta, as the stages of an implicit
    one may have no solution in a step that cannot be shortened; `ValueError` for fewer than 5
    steps.
    """

    solver: Unrolled = eqx.field(default_factory=Verner9, converter=_unrolled)
    steps_per_cycle: int = eqx.field(static=True, default=10)  # pyright: ignore

    takes_implicit: ClassVar[bool] = False
    """Whether the solver may be implicit."""

    def __check_init__(self):
        count("steps_per_cycle", self.steps_per_cycle, least=5)
        if self.solver.implicit and not self.takes_implicit:
            raise TypeError(
                "Argument `solver` of `FixedStep` must be an explicit diffrax Runge–Kutta solver, "
                f"but got {self.solver.solver!r}. Use `Adaptive`."
            )

    def may_be_unstable(self, machine, s, state):
        """True if the fastest decay of the machine is unknown."""
        return self.follows_fading and not fading_is_known(machine, s, state)

    def step_with_stages(self, smooth, s0, s1, state, beside):
        """One Runge–Kutta step, whether it is unstable, and its stages."""
        new, after, _, slopes, stages = _runge_kutta(self.solver, smooth, s0, s1, state, beside)
        error = jnp.zeros_like(s0)
        if self.may_be_unstable(smooth.machine, s0, state):
            error = self._unstable(
                (state, new), [slope for slope, _ in slopes], s1 - s0, unit_of(smooth.machine)
            )
        return new, after, error, stages

    def _unstable(
        self, ends: tuple[State, State], slopes: list[State], h: Scalar, unit: Scalar | float
    ) -> Scalar:
        """More than 1 if a step is unstable, else 0.

        **Arguments:** the state at both `ends`; `slopes`, of the state at each stage; `h`, the
        step's length; `unit`, as `unit_of` the machine.
        """
        # Of bodies at rest in zero all that is left is rounding.
        rounding = float(jnp.finfo(h.dtype).eps) ** 0.5
        before, after = (jnp.maximum(_size(x), rounding) for x in ends)
        if not isinstance(unit, float):  # of other units of time rates are much larger, or smaller
            after = jnp.maximum(after, jnp.where(unit == 1, 0.0, unit * _size(slopes[0])))

        def judged(size, h, slopes):
            apart = _size(self.solver.error(slopes, h))
            return jnp.where(apart > _UNSTABLE * size, 2.0, jnp.zeros_like(h))

        # A step over less than what changes the state by itself is stable, and its error not asked.
        given = jax.lax.stop_gradient((jnp.maximum(before, after), h, slopes))
        long = given[1] * _size(slopes[0]) > before
        return jax.lax.cond(long, judged, lambda size, h, slopes: jnp.zeros_like(h), *given)

    def tighter(self):
        """The same solver with twice as many steps a cycle."""
        return FixedStep(self.solver, 2 * self.steps_per_cycle)


class ImplicitSteps(FixedStep):
    """An implicit solver with a fixed number of steps in a cycle, however fast something fades: by
    these the branch of a stiff machine is followed. Where the stages of a step have no solution its
    end is not a number."""

    takes_implicit = True

    @property
    def follows_fading(self):
        """Never, as with `Adaptive` and such a solver."""
        return False

    def step_with_stages(self, smooth, s0, s1, state, beside):
        """One Runge–Kutta step, and the stages of the solver; its error is not asked for."""
        solver = Unrolled(self.solver.solver, tolerance=8 * jnp.finfo(s0.dtype).eps)
        new, beside, errors, _, stages = _runge_kutta(solver, smooth, s0, s1, state, beside)
        solved = jnp.isfinite(sum(map(jnp.sum, jtu.tree_leaves(errors))))
        new = jtu.tree_map(lambda x: jnp.where(solved, x, jnp.nan), new)
        return new, beside, jnp.zeros_like(s0), stages

    def tighter(self):
        """The same solver with twice as many steps a cycle."""
        return ImplicitSteps(self.solver, 2 * self.steps_per_cycle)
