# %% [markdown]
"""# A block on a belt, and how many starts come to rest

A block on a spring lies on a belt of speed v. It either comes to rest on the sliding belt, or
sticks and slips for ever. The share of starts in [-2, 2] × [0, 2] that come to rest is compared.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% x'' = -x - 0.1 x' + friction
class Belt(vi.AbstractMachine):
    speed: jax.Array | float
    cycle = 100.0

    @property
    def contacts(self):
        level = lambda speed: 0.5 + 0.5 * jnp.exp(-2 * speed)
        return vi.DryFriction(level, on="V", slip=lambda z: z.V - self.speed)

    def field(self, s, z):
        return dict(Y=z.V, V=-z.Y - 0.1 * z.V)


def rests(speed, Y, V):  # by their criterion: it moves by less than ±0.2 from t = 400 to 500
    run = vi.simulate(Belt(speed), vi.OscillatorState(Y, V), 1, settle=4)
    return run.y_max[0] - run.y_min[0] < 0.4


# %% Starts on a grid of 64²
speeds = np.array([1.175, 1.25, 1.4, 1.5, 1.625, 1.775, 1.85])
theirs = np.array([0.0126, 0.0838, 0.211, 0.312, 0.4336, 0.5552, 1])
grid = np.meshgrid((np.arange(64) - 31.5) / 16, (np.arange(64) + 0.5) / 32)
lanes = vi.jit(jax.vmap(jax.vmap(rests, (None, 0, 0)), (0, None, None)))
ours = np.asarray(lanes(speeds, *(x.ravel() for x in grid))).mean(axis=1)
rows = zip(speeds, theirs, ours, 3 * np.sqrt(theirs * (1 - theirs) / 5000), strict=True)
comparison = Comparison(
    "bSTAB, pyBasin",
    "https://github.com/TUHH-DYN/bSTAB and https://github.com/adrianwix/pyBasin, `friction`",
    "printed in pyBasin's results; of 5,000 random starts, so right to three standard errors",
    [(f"share at v = {v:g}", f"{p:g}", x, error) for v, p, x, error in rows],
)
print(comparison)
