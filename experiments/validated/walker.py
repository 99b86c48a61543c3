# %% [markdown]
"""# The simplest walking model

Two rigid legs with a mass at the hip walk down a slope of 0.009 rad. There are two gaits, and the
one with long steps is stable.
"""

# %%
import jax
import jax.numpy as jnp
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% The state: angle of the stance leg, its rate, the angle between both legs, its rate
def legs(a, w):  # just after a heel strike
    return tuple(map(jnp.asarray, (a, w, 2 * a, w * (1 - jnp.cos(2 * a)))))


strikes = lambda walker, s, x: x[2] - 2 * x[0]
changed = lambda walker, s, x: legs(-x[0], x[1] * jnp.cos(2 * x[0]))
apart = lambda walker, s, x: x[2] < -0.05  # ignores foot scuffing as the legs pass each other


class Walker(vi.AbstractMachine):
    slope: jax.Array | float = 0.009
    cycle: float = 4.0  # about the duration of a step
    events: tuple = (vi.Reset(strikes, changed, when=apart, ends_cycle=True),)

    def field(self, s, x):
        stance, turning, between, swinging = x
        falls, weight = jnp.sin(stance - self.slope), jnp.cos(stance - self.slope)
        return turning, falls, swinging, falls + (turning**2 - weight) * jnp.sin(between)


long, short = (vi.find_orbit(Walker(), legs(*x)) for x in ((0.2, -0.2), (0.1939, -0.2039)))
pair = long.multipliers[jnp.argmax(long.multipliers.imag)]
comparison = Comparison(
    "Garcia et al. (1998), Bhounsule (2014)",
    "J. Biomech. Eng. 120, 281 (1998), and Dyn. Contin. Discrete Impuls. Syst. B 21, 137 (2014)",
    "printed in the authors' MATLAB programs, Garcia's of 1998 (the multiplier 4.000, right to "
    "0.1 %) and Bhounsule's of 2013; the pair of multipliers by SciPy at 1e-13",
    [
        ("long steps: angle of the leg (rad)", "0.200310900563820", long.state[0], 1e-10),
        ("its rate", "-0.199832473025474", long.state[1], 1e-10),
        ("multipliers: real part", "-0.19009984", pair.real, 1e-7),
        ("imaginary part", "0.55759878", pair.imag, 1e-7),
        ("short steps: angle of the leg (rad)", "0.193937369810188", short.state[0], 1e-10),
        ("largest multiplier", "4.000", jnp.abs(short.multipliers).max(), 5e-3),
    ],
)
print(comparison)
