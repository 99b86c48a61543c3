# %% [markdown]
"""# A ball on a wavy ramp

A ball (e = 0.8) bounces ten times down a ramp, y = 1 - x + 0.05 cos 11πx. Then it bounces along the
ground, until two impacts follow within 1e-6.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% The state is (x, y, x', y'); the ramp is a user-defined reset, the ground a stop
def bounced(ramp, s, z):
    normal = 1 + 0.55 * jnp.pi * jnp.sin(11 * jnp.pi * z[0])
    change = 1.8 * (normal * z[2] + z[3]) / (normal**2 + 1)
    return z[0], z[1], z[2] - normal * change, z[3] - change


inside = lambda ramp, s, z: 1 - z[0] + 0.05 * jnp.cos(11 * jnp.pi * z[0]) - z[1]


class Ramp(vi.AbstractMachine):
    contacts: tuple = (vi.RigidStop(0.0, 0.8, "left"),)
    events: tuple = (vi.Reset(inside, bounced),)
    coordinates: tuple = (
        vi.Coordinate(lambda z: z[1], lambda z: z[3], lambda z, Y, V: (z[0], Y, z[2], V)),
    )
    cycle: float = 10.0

    def field(self, s, z):
        return z[2], z[3], 0 * z[2], -9.8 + 0 * z[3]


start = tuple(map(jnp.array, (0.0, 1.2, 0.0, 0.0)))
log = vi.simulate(Ramp(), start, 1, event_log=80, method=vi.Adaptive(rtol=1e-13)).event_log
ground = np.asarray(log.phase[0])[np.asarray(log.kind[0]) == vi.EVENTS.index("impact")]
waits = (ground[1] - ground[0]) * 0.8 ** np.arange(99)
stops = ground[0] + np.cumsum(waits)[np.argmax(waits < 1e-6)]
comparison = Comparison(
    "heyoka.py",
    "https://bluescarni.github.io/heyoka.py, The wavy ramp",
    "printed in its documentation; ten bounces magnify rounding, so that they agree to 1e-10",
    [("it stops at", "4.739019126545602", stops, 1e-10)],
)
print(comparison)
