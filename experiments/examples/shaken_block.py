# %% [markdown]
"""# A block on a shaken floor rocks, hops or overturns

The floor shakes a block of 0.2 m by 1 m obliquely: what does it do in ten cycles?
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import vi_jax as vi


def corner(side):
    height = lambda q: q.y + side * jnp.sin(q.tilt) - 0.5 * jnp.cos(q.tilt)
    place = lambda q: q.x + side * jnp.cos(q.tilt) + 0.5 * jnp.sin(q.tilt)
    return vi.RigidStop(0.0, 0.0, "left", on=height, friction=0.5, along=place)


class Block(vi.Mechanical):
    q, mass, contacts = ("x", "y", "tilt"), (1.0, 1.0, 0.0867), (corner(-0.1), corner(0.1))
    hertz: float = 2.0
    peak: float = 0.5  # greatest acceleration of the floor / g
    cycle = property(lambda block: 1 / block.hertz)
    events = vi.Reset(lambda block, t, z: abs(z.tilt) - 1.2, ends="overturns")
    averages = lambda self, t, z: {"rocks": abs(z.tilt), "rises": z.y - 0.5 * jnp.cos(z.tilt)}

    def force(self, t, q, v):
        ground = 9.81 * self.peak * jnp.sin(2 * jnp.pi * self.hertz * t)
        return {"x": -ground, "y": -9.81 - ground, "tilt": 0.0}


axes = {"hertz": jnp.linspace(0.5, 6, 40), "peak": jnp.linspace(0.05, 1.6, 40)}
means = lambda block, run: {x: jnp.nanmax(run.averages[x]) for x in ("rocks", "rises")}
d = vi.scan(Block(), axes, measure=means, start=Block().at(y=0.5), settle=0, cycles=10)
kind = (0 * d.rocks + (d.rocks > 1e-6) + (d.rises > 0.1 * d.rocks + 1e-6)).where(d.outcome < 0, 3)
picture = kind.plot(x="hertz", levels=[-0.5, 0.5, 1.5, 2.5, 3.5], cmap="viridis", figsize=(8, 4))
picture.colorbar.set_ticks(range(4), labels=["stands", "rocks", "hops", "overturns"])
picture.figure.savefig("shaken_block.png")
