# %% [markdown]
"""# Stops widen the band of a vibration harvester

A 10 g magnet on a spring (30 Hz) moves in a coil. Its base has a random acceleration w of 20 m/s²
(rms) in a band 3 Hz wide. Stops cost power at resonance but widen the band (gap 1 m: no stops).
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

OWN, LOSS, WIDTH = 60 * jnp.pi, 0.08 * 60 * jnp.pi, 6 * jnp.pi  # rad/s; coil: 3/4 of the loss


class Harvester(vi.AbstractMachine):
    centre: float = 30.0
    gap: float = 1.0
    cycle, units = 1 / 30, {"gap": "m"}
    contacts = property(lambda m: (vi.RigidStop(m.gap, 0.6), vi.RigidStop(m.gap, 0.6, "left")))

    def field(self, t, z):
        filtered = -((2 * jnp.pi * self.centre) ** 2) * z.y - WIDTH * z.w
        return {"Y": z.V, "V": -(OWN**2) * z.Y - LOSS * z.V - z.w, "y": z.w, "w": filtered}

    def averages(self, t, z):
        return {"power": 1e3 * 0.01 * 0.75 * LOSS * z.V**2}  # mW


axes = {"gap": [0.001, 0.002, 1.0], "centre": jnp.linspace(20, 50, 31), "noise.path": range(32)}
noise, key = vi.WhiteNoise({"w": 20 * (2 * WIDTH) ** 0.5}), jax.random.key(0)
options = {"start": vi.State(Y=0.0, V=0.0, y=0.0, w=0.0), "noise": noise, "key": key}
data = vi.scan(Harvester(), axes, measure="power", settle=50, cycles=300, **options)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
data.power.mean("noise.path").plot.line(x="centre", ax=ax, marker="o")
ax.set(yscale="log", xlabel="centre of the band (Hz)", ylabel="harvested power (mW)")
figure.savefig("harvester.png")
