"""Compiled programs are dropped before the process reaches Linux's limit of memory maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax import _programs


def test_a_compiled_function_works_within_other_programs():
    function = _programs.CompiledFunction(lambda x: jnp.sin(x) * x)
    x = jnp.asarray(0.7)
    alone = function(x)
    within = jax.jit(lambda y: function(x) + 0 * y)(x)  # its argument is concrete there
    np.testing.assert_allclose([within, jax.jit(function)(x)], alone, rtol=1e-15)
    np.testing.assert_allclose(jax.vmap(function)(jnp.stack([x, x])), alone, rtol=1e-15)
    np.testing.assert_allclose(jax.grad(function)(x), jnp.sin(x) + x * jnp.cos(x), rtol=1e-15)


def test_compiler_options_unknown_to_xla_are_left_out():
    known = _programs._supported(_programs.PLAIN)  # none since JAX 0.12
    options = {"xla_no_such_option": 1, **_programs.PLAIN}
    assert _programs._supported(options) == known
    assert float(_programs.CompiledFunction(lambda x: x + 1, options)(jnp.asarray(1.0))) == 2.0


@pytest.mark.parametrize("derivative", [jax.jacfwd, pytest.param(jax.grad, marks=pytest.mark.slow)])
def test_a_machine_may_close_over_differentiated_numbers(derivative):
    """The class is defined in a function of its parameters, and its guard computes with them."""

    def last(numbers):
        class Shaken(vi.AbstractMachine):
            contacts: tuple = (vi.RigidStop(0.8, 0.7),)
            cycle: float = 2 * np.pi

            @property
            def events(self):
                pushed = lambda machine, s, x: vi.OscillatorState(x.Y, x.V + 0.1 * numbers[1])
                return vi.Reset(lambda machine, s, x: x.Y + jnp.sin(numbers[0]) / 9, pushed)

            def field(self, s, state):
                pull = numbers[1] * jnp.cos(s) - state.Y * numbers[0]
                return vi.OscillatorState(state.V, pull - 0.1 * state.V)

        start = vi.OscillatorState(numbers[2], numbers[3])
        run = vi.simulate(Shaken(), start, 2, method=vi.Adaptive(rtol=1e-12))
        return run.last.Y + run.y_min[0]

    at = jnp.array([1.2, 1.5, 0.1, 0.2])
    found = derivative(last)(at)
    steps = 1e-5 * jnp.eye(4)
    up, down = jax.jit(jax.vmap(jax.vmap(last)))(jnp.stack([at + steps, at - steps]))
    truth = (up - down) / 2e-5
    np.testing.assert_allclose(found, truth, rtol=1e-7)
