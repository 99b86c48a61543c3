# %% [markdown]
"""# The derivative of a bounce

Without gravity or loss, a ball raised by 1 cm at the start ends 1 cm lower, since it arrives later.
Simulators that step over the contact give +1, or a jump. The second case has gravity, e = 0.8 and
T = 1 s.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% Height Y (m) over a second
class Ball(vi.AbstractMachine):
    gravity: jax.Array | float
    contacts: tuple[vi.RigidStop, ...]
    cycle: float = 1.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -self.gravity + 0 * state.V)


def ends(height, restitution, gravity, speed):
    ball = Ball(gravity, (vi.RigidStop(0.0, restitution, "left"),))
    start = vi.OscillatorState(jnp.asarray(height), jnp.asarray(speed))
    return vi.simulate(ball, start, 1, method=vi.Adaptive(rtol=1e-12)).last.Y


flies, drops = (2.95, 1.0, 0.0, -5.0), (1.0, 0.8, 9.81, 0.0)
apart = (ends(1.0 + 1e-5, *drops[1:]) - ends(1.0 - 1e-5, *drops[1:])) / 2e-5

# %% v is the speed before the first impact, e v the speed after it
g, e, v = 9.81, 0.8, np.sqrt(2 * 9.81)
by_height, again = g * (1 + e) / v - 1 - 2 * e, -(g**2) * (1 + e) / v**3
comparison = Comparison(
    "Brax, MuJoCo MJX, DiffTaichi",
    "https://github.com/google/brax/issues/317, https://github.com/google-deepmind/mujoco/issues/"
    "2841; Y. Hu and others, DiffTaichi, ICLR 2020 (time of impact)",
    "in closed form",
    [
        ("no gravity, with respect to the height: forward", "-1", jax.jacfwd(ends)(*flies)),
        ("backward", "-1", jax.grad(ends)(*flies)),
        ("with gravity", f"{by_height:.12f}", jax.grad(ends)(*drops)),
        ("the same by differences of runs", f"{by_height:.12f}", apart, 1e-8),  # h² and rounding/h
        ("second derivative", f"{again:.12f}", jax.jacfwd(jax.jacfwd(ends))(*drops)),
        ("with respect to the restitution", f"{v - v**2 / g:.12f}", jax.grad(ends, 1)(*drops)),
    ],
)
print(comparison)
