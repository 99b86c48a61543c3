# %% [markdown]
"""# Two bouncing balls

`ballode` throws a ball up at 20 m/s (e = 0.9). Simulink's ball (15 m/s from 10 m, e = 0.8) has
infinitely many impacts in finite time. Its solver may stop there; here the ball comes to rest.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% Height Y (m) over 50 s
class Ball(vi.AbstractMachine):
    gravity: jax.Array | float
    contacts: tuple[vi.RigidStop, ...]
    cycle: float = 50.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -self.gravity + 0 * state.V)


def events(gravity, restitution, height, speed):
    """Return the times of the impacts, and the time at which the ball comes to rest."""
    start = vi.OscillatorState(jnp.array(height), jnp.array(speed))
    ball = Ball(gravity, (vi.RigidStop(0.0, restitution, "left"),))
    log = vi.simulate(ball, start, 1, event_log=250).event_log
    kind, time = np.asarray(log.kind[0]), np.asarray(log.phase[0])
    return time[kind == vi.EVENTS.index("impact")], time[kind == vi.EVENTS.index("rest")]


tossed, _ = events(9.8, 0.9, 0.0, 20.0)
thrown, rest = events(9.81, 0.8, 10.0, 15.0)
# %% A flight lasts 2 v/g, and each flight is e times as long as the one before
fall = np.sqrt(15.0**2 + 2 * 9.81 * 10)
lands = (15 + fall) / 9.81
comparison = Comparison(
    "MATLAB, Simulink",
    "https://www.mathworks.com/help/matlab/math/ode-event-location.html (`ballode`) and "
    "https://www.mathworks.com/help/simulink/slref/simulation-of-a-bouncing-ball.html",
    "in closed form: its documentation shows pictures",
    [
        ("`ballode`: first bounce (s)", f"{40 / 9.8:.12f}", tossed[0]),
        ("tenth bounce (s)", f"{40 / 9.8 * (1 - 0.9**10) / 0.1:.12f}", tossed[9]),
        ("Simulink: first impact (s)", f"{lands:.12f}", thrown[0]),
        ("at rest (s)", f"{lands + 2 * 0.8 * fall / 9.81 / 0.2:.12f}", rest[0]),
    ],
)
print(comparison)
