# %% [markdown]
"""# Derivatives of the time of an event

A mass on a spring of stiffness k starts with speed 1. The derivatives of the time of its first
turning point and of the misfit (x - 10.123)² there are compared.
"""

# %%
import jax
import jax.numpy as jnp
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% A cycle ends where the velocity falls through zero
class Spring(vi.AbstractMachine):
    stiffness: jax.Array | float
    cycle = vi.falling("V", usual=2.0)

    def field(self, s, state):
        return vi.OscillatorState(state.V, -self.stiffness * state.Y)


def turn(stiffness):
    """Return the time of the turning point, and the misfit of its position."""
    start = vi.OscillatorState(jnp.array(0.0), jnp.array(1.0))
    run = vi.simulate(Spring(stiffness), start, 1, method=vi.Adaptive(rtol=1e-13))
    return run.duration[0], (run.last.Y - 10.123) ** 2


# %%
comparison = Comparison(
    "heyoka.py",
    "https://bluescarni.github.io/heyoka.py, Computing event sensitivity",
    "printed in its documentation",
    [
        (
            "derivative of the time with respect to k, k = 0.456",
            "-2.5506015388296643",
            jax.grad(lambda k: turn(k)[0])(0.456),
        ),
        (
            "derivative of the misfit with respect to k, k = 7.23",
            "0.5015866697490922",
            jax.grad(lambda k: turn(k)[1])(7.23),
        ),
    ],
)
print(comparison)
