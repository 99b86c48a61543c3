# %% [markdown]
"""# Which ground motion overturns a block

One sine cycle of the ground can overturn a 0.5 m by 2 m block (yellow); a stronger one may not.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import vi_jax as vi

lands = lambda m, t, z, side: -side * z.tilt


# %% Housner's block: `peak` is in g, `time` begins at uplift, and 7.13/s² is 3g/(4R)
class Block(vi.AbstractMachine):
    peak: float = 0.5
    frequency: float = 1.0
    cycle, modes = 0.2, {"side": -1.0}
    events = (
        vi.Reset(lands, when=lambda m, t, z, side: abs(z.rate) < 0.05, ends="stands"),
        vi.Reset(lands, lambda m, t, z, side: {"rate": 0.912 * z.rate}, modes=lambda *x: -x[3]),
        vi.Reset(lambda m, t, z, side: side * z.tilt - jnp.pi / 2, ends="lies"),
    )

    def field(self, t, z, side):
        angle = 2 * jnp.pi * self.frequency * z.time + jnp.arcsin(0.25 / self.peak)
        ground = jnp.where(angle < 2 * jnp.pi, self.peak * jnp.sin(angle), 0.0)
        pull = jnp.sin(side * 0.245 - z.tilt) + ground * jnp.cos(side * 0.245 - z.tilt)
        return {"tilt": z.rate, "rate": -7.13 * pull, "time": 1.0}


axes = {"frequency": jnp.linspace(0.4, 2.5, 100), "peak": jnp.linspace(0.26, 2.0, 100)}
start = vi.State(tilt=0.0, rate=0.0, time=0.0)
data = vi.scan(Block(), axes, start=start, measure="steps", settle=0, cycles=200, progress=False)
drawn = data["outcome"].plot(x="frequency", figsize=(8, 4), add_colorbar=False)  # pyright: ignore
drawn.axes.set(xlabel="frequency of the ground (Hz)", ylabel="its greatest acceleration (g)")
drawn.figure.savefig("rocking_block.png")
