# %% [markdown]
"""# A robot on two feet walks by an unbalanced motor

The motor makes the feet slip while their load is small. Above 11 Hz they leave the floor.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import vi_jax as vi


# %% SI units: 1 kg, two feet 0.12 m apart and 0.03 m below the centre, an unbalance of 2 g m
def foot(side, friction):
    height = lambda q: q.y + side * jnp.sin(q.tilt) - 0.03 * jnp.cos(q.tilt)
    place = lambda q: q.x + side * jnp.cos(q.tilt) + 0.03 * jnp.sin(q.tilt)
    return vi.RigidStop(0.0, 0.0, "left", on=height, friction=friction, along=place)


class Walker(vi.Mechanical):
    q, mass, units = ("x", "y", "tilt"), (1.0, 1.0, 0.0015), {"friction": "1"}
    friction: float = 0.4
    frequency: float = 10.0
    cycle = property(lambda m: 1 / m.frequency)
    contacts = property(lambda m: (foot(-0.06, m.friction), foot(0.06, m.friction)))
    start, averages = lambda m: m.at(y=0.03), lambda m, t, z: {"speed": z.v.x}

    def force(self, t, q, v):
        turn = 2 * jnp.pi * self.frequency
        push, lift = (0.002 * turn**2 * f(turn * t) for f in (jnp.cos, jnp.sin))
        return {"x": push, "y": lift - 9.81, "tilt": -0.01 * push}


axes = {"friction": [0.1, 0.2, 0.4, 0.8], "frequency": jnp.linspace(3, 16, 66)}
data = vi.scan(Walker(), axes, measure="speed", settle=10, cycles=20, progress=False)
lines = data.speed.plot.line(x="frequency", figsize=(8, 4))
lines[0].axes.set(xlabel="frequency of the motor (Hz)", ylabel="mean speed (m/s)")
lines[0].figure.savefig("walker.png")
