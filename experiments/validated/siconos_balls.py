# %% [markdown]
"""# A ball that bounces, and one between floor and ceiling

A ball drops on a floor (g = 9.81, e = 0.9). Another is thrown at a ceiling (g = 10, e = 0.8) and
comes to rest on the floor after infinitely many impacts.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% Height Y above the floor (m) over 10 s
class Ball(vi.AbstractMachine):
    gravity: jax.Array | float
    contacts: tuple[vi.RigidStop, ...]
    cycle: float = 10.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -self.gravity + 0 * state.V)


def events(ball, height, speed):
    """Return the times of the impacts, and the time at which the ball comes to rest."""
    start = vi.OscillatorState(jnp.array(height), jnp.array(speed))
    log = vi.simulate(ball, start, 1, event_log=200).event_log
    kind, time = np.asarray(log.kind[0]), np.asarray(log.phase[0])
    return time[kind == vi.EVENTS.index("impact")], time[kind == vi.EVENTS.index("rest")]


drop, _ = events(Ball(9.81, (vi.RigidStop(0.0, 0.9, "left"),)), 1.0, 0.0)
floor, ceiling = vi.RigidStop(0.0, 0.8, "left"), vi.RigidStop(1.5, 0.8)
box, rest = events(Ball(10.0, (floor, ceiling)), 1.0, 10.0)

# %% Some of the impacts
comparison = Comparison(
    "Siconos",
    "https://github.com/siconos/siconos-tutorials, `examples/mechanics/BouncingBallEventDriven`",
    "printed in the reference files of its tests; the time of rest in closed form",
    [
        ("dropped: first impact (s)", "0.4515236409857308", drop[0]),
        ("third impact (s)", "1.995734493156927", drop[2]),
        ("impacts in the first 8.5 s", "44", np.sum(drop < 8.5)),
        ("last of them (s)", "8.491374025642981", drop[43], 1e-11),  # theirs adds up flights
        ("between two walls: first impact (s)", "0.05131670194948630", box[0]),
        ("tenth impact (s)", "4.774390309357649", box[9]),
        ("at rest (s)", "6.20723724208632", rest[0]),
    ],
)
print(comparison)
