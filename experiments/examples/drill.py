# %% [markdown]
"""# How fast a percussion drill goes into the rock

A vibrating bit of 5 kg strikes rock. The contact is a spring with a dashpot, and a force of 20 kN
moves the rock. Too little feed force wastes blows, and too much of it stops the progress.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


# %% A soft stop between bit and rock, and dry friction that holds the rock; SI units, 50 Hz
class Drill(vi.Mechanical):
    q, mass, cycle, units = ("bit", "rock"), (5.0, 0.5), 0.02, {"shaking": "N"}
    feed: float = 300.0
    shaking: float = 1000.0
    contacts = (
        vi.SoftStop(0.0, 5e8, dashpot=1e4, on=lambda q: q.bit - q.rock),
        vi.DryFriction(20e3, on="rock"),
    )

    def force(self, t, q, v):
        return {"bit": self.feed + self.shaking * jnp.cos(100 * jnp.pi * t), "rock": 0.0}

    def averages(self, t, z):
        return {"rate": 1e3 * z.v.rock}


axes = {"shaking": [500.0, 1000.0, 1500.0], "feed": jnp.linspace(20, 800, 79)}
data = vi.scan(Drill(), axes, measure="rate", settle=100, cycles=50, progress=False)
print("best feed (N):", data.rate.idxmax("feed").values)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
data.rate.plot.line(x="feed", ax=ax)
ax.set(xlabel="feed force (N)", ylabel="rate of penetration (mm/s)")
figure.savefig("drill.png")
