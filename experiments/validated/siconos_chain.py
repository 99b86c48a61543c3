# %% [markdown]
"""# Ten balls in a row, by Hertz's law

A ball at 1 m/s strikes nine equal ones that touch. Each pair pushes with K δ^(3/2). The final
speeds do not depend on K, which is 1 here.
"""

# %%
import jax
import jax.numpy as jnp
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% The state: displacements from the positions where all touch, and velocities
class Chain(vi.AbstractMachine):
    stiffness: jax.Array | float = 1.0
    cycle: float = 60.0

    def field(self, s, balls):
        x, v = balls
        push = self.stiffness * jnp.maximum(x[:-1] - x[1:], 0.0) ** 1.5
        return v, -jnp.diff(push, prepend=0.0, append=0.0)

    def position(self, balls):
        return balls[0][0]

    def velocity(self, balls):
        return balls[1][0]


start = jnp.zeros(10), jnp.zeros(10).at[0].set(1.0)
_, v = vi.simulate(Chain(), start, 1, method=vi.Adaptive(rtol=1e-11)).last

# %%
comparison = Comparison(
    "Siconos",
    "https://github.com/siconos/siconos-tutorials, `examples/mechanics/ChainOfBalls`",
    "printed in the reference file of its test, from the impact model of Liu, Zhao and Brogliato "
    "in steps of the impulse, which is off by up to 5e-4; others by SciPy's DOP853 at 1e-12",
    [
        ("the first (m/s)", "-0.07105929", v[0], 1e-3),
        ("the second", "-0.03018624", v[1], 1e-3),
        ("the eighth", "0.00262452", v[7], 1e-3),
        ("the ninth", "0.14692339", v[8], 1e-3),
        ("the last", "0.98595612", v[9], 1e-3),
        ("by SciPy: the first", "-0.07108502", v[0]),
        ("by SciPy: the ninth", "0.14739031", v[8]),
        ("by SciPy: the last", "0.98586587", v[9]),
    ],
)
print(comparison)
