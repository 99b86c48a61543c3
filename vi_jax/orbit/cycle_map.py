"""The cycle map: from a state on the section to the state n drive cycles later."""

import contextlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._checks import count, from_host, require
from .._messages import warning_once
from .._programs import compiled
from .._types import State
from ..flow import (
    AbstractMethod,
    Adaptive,
    FixedStep,
    MethodLike,
    as_floats,
    check_finite,
    check_reals,
    check_values,
    chosen,
    machine_of,
    preset,
    shape_of,
    simulate,
)
from ..machine import (
    AbstractMachine,
    HybridState,
    at_section,
    begun,
    clock_of,
    convert_start,
    in_cycle_clock,
    in_cycle_state,
    may_rest,
    modes_of,
    raveled,
    without_modes,
)


def forward_jacobian(f: Callable[..., Any]) -> Callable[..., Any]:
    """Return `f` with its Jacobian, computed in forward mode, times the tangent as derivative.

    The Jacobian has columns for differentiated leaves only. Inside another derivative, such as an
    orbit's by the implicit function theorem, the columns are few and stay together.
    """

    @eqx.filter_custom_jvp
    def wrapped(*args):
        return batch_together(f(*args), args)

    @wrapped.def_jvp
    def _(primals, tangents):
        perturbed = jtu.tree_map(lambda t: t is not None, tangents, is_leaf=lambda t: t is None)

        def columns(*args):
            moving, fixed = eqx.partition(args, perturbed)
            flat, unravel = ravel_pytree(moving)

            def along(direction):
                def moved(moving):
                    return f(*eqx.combine(moving, fixed))

                return jax.jvp(moved, (moving,), (unravel(direction),))

            basis = jnp.eye(flat.size, dtype=flat.dtype)
            return jax.vmap(along, out_axes=(None, -1))(basis)

        out, jacobian = forward_jacobian(columns)(*primals)
        step, _ = ravel_pytree(tangents)
        return out, jtu.tree_map(lambda column: column @ step, jacobian)

    return wrapped


def batch_together(out: object, args: object) -> Any:
    """Return `out`, batched by `vmap` in every leaf if a leaf of `args` is.

    JAX mixes up the axes of a staged custom derivative whose values are batched in other leaves
    than its tangents.
    """
    leaves = [x for x in jtu.tree_leaves(args) if eqx.is_inexact_array(x)]
    flag = sum(jnp.sum(x) for x in leaves) > 0
    return jtu.tree_map(lambda x: jnp.where(flag, x, x), out)


class CycleMap(eqx.Module):
    """The Poincaré map of a machine over `cycles` drive cycles, from a state on the section to the
    state there; made by `cycle_map`.

    Differentiable in forward and in reverse mode, to any order, with respect to the state and every
    leaf of the machine; works under `jit` and `vmap`. The values of a failed run are NaN.
    """

    machine: AbstractMachine
    """The machine in the phase clock; a `Scene` carries the section phase."""
    method: AbstractMethod
    cycles: int = eqx.field(static=True)
    rests: bool = eqx.field(static=True)
    """True if the body may come to rest on a stop."""

    def __call__(self, state: State) -> State:
        """Return the state `cycles` drive cycles later; a `HybridState` with discrete modes."""
        return _end(self, map_state(self.machine, state))

    def residual(self, state: State) -> State:
        """Return the mapped state minus `state`, zero for a periodic motion."""
        state = map_state(self.machine, state)
        return jtu.tree_map(
            lambda a, b: a - b, without_modes(_end(self, state)), without_modes(state)
        )

    def jacobian(self, state: State) -> Float[Array, "states states"]:
        """Return the map's derivative: the monodromy matrix if `state` lies on a periodic motion.

        Rows and columns are in the order of the state's leaves: Y, V, and W for a motor.
        """
        return _jacobian(self, map_state(self.machine, state))


@compiled
def _jacobian(cycle_map: CycleMap, state: State) -> Float[Array, "states states"]:
    x, unravel = raveled(state)
    return jax.jacfwd(lambda x: raveled(_end(cycle_map, unravel(x)))[0])(x)


@forward_jacobian
def _end(cycle_map: CycleMap, state: State) -> State:
    run = simulate(
        cycle_map.machine, state, cycle_map.cycles, method=cycle_map.method, record="sections",
        rests=cycle_map.rests,
    )  # fmt: skip
    return run.last


@warning_once
def cycle_map(
    machine: AbstractMachine,
    cycles: int | Int[Array, ""] = 1,
    *,
    method: MethodLike = None,
    section: Any = None,
) -> CycleMap:
    """Return the Poincaré map of `machine` over a number of drive cycles.

    **Arguments:**

    - `machine`: a `Scene` with an ideal drive (2 states) or a motor (3 states), or another machine
      whose independent variable counts its cycles. A machine in the time clock is observed by the
      angle of its shaft.
    - `cycles`: number of drive cycles n, at least 1; static.
    - `method`: integration method: by default the `"standard"` preset, as in `simulate`, except
      `Adaptive(Tsit5(), rtol=1e-11)` for a `Scene` with a motor.
    - `section`: crank angle of the section (radians); by default the machine's own, which is 0.

    **Returns:** a `CycleMap`: call it on a state from `machine.start(...)`.

    **Raises:** `ValueError` or `TypeError` for invalid arguments.
    """
    machine = in_cycle_clock(machine_of(machine))
    if section is not None:
        require("section", section)
        machine = at_section(machine, section)
    default = preset(machine)
    if isinstance(default, FixedStep):  # its errors are too large for an orbit
        import diffrax  # slow to load

        default = Adaptive(diffrax.Tsit5(), rtol=1e-11)
    method = chosen(machine, method, default)
    method.check(machine)
    # Tolerances are numbers: another tolerance must not need another compilation.
    traced_method: AbstractMethod = jtu.tree_map(
        lambda x: from_host(x) if isinstance(x, np.ndarray) else x, method
    )
    return CycleMap(machine, traced_method, count("cycles", cycles, least=1), may_rest(machine))


def map_state(machine: AbstractMachine, state: State, name: str = "state") -> State:
    """Convert a state for a cycle map: floating-point arrays of one type, with its modes."""
    modes, state = modes_of(state), without_modes(state)
    state = convert_start(machine, in_cycle_state(machine, name, state))
    check_reals(name, state)
    if clock_of(machine, state) is not None:
        raise ValueError(
            "Argument `machine` must count its cycles by its independent variable, but its state "
            "has a clock."
        )
    if not axes_of(machine, state):
        check_finite(name, state)
    elif all(map(jnp.size, jtu.tree_leaves(state))):
        shape_of(name, machine, jtu.tree_map(lambda x: jnp.atleast_1d(x)[0], state))
    check_values(machine, state)
    state = as_floats(machine, state)
    if modes is None:
        return begun(machine, state, axes_of(machine, state))
    dtype = machine.position(state).dtype
    return HybridState(state, tuple(jnp.asarray(mode, dtype) for mode in modes))


def axes_of(machine: AbstractMachine, state: State) -> int:
    """Return the number of batch axes of a guess, the dimension of its position."""
    with contextlib.suppress(AttributeError, TypeError, LookupError):  # invalid states raise later
        return jnp.ndim(machine.position(without_modes(state)))
    return int(any(jnp.ndim(leaf) for leaf in jtu.tree_leaves(without_modes(state))))
