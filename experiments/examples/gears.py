# %% [markdown]
"""# When a loose gear rattles

An engine's speed varies within a turn. Its gear drives a loose gear with a backlash of 0.1 mm.
Drag keeps the teeth in contact until the ripple exceeds drag over inertia (dashed).
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

INERTIA, RADIUS, PLAY = 1e-3, 0.04, 1e-4  # kg m², m, m


# %% Y: position of the loose tooth in the backlash, along the line of action; SI units, 50 Hz
class Gears(vi.AbstractMachine):
    drag: float = 0.3
    ripple: float = 800.0
    cycle, units = 0.02, {"drag": "N m"}
    contacts = vi.RigidStop(0.0, 0.6, "left"), vi.RigidStop(PLAY, 0.6)

    def field(self, t, z):
        ripple = self.ripple * jnp.cos(100 * jnp.pi * t)
        return {"Y": z.V, "V": RADIUS * (ripple - self.drag / INERTIA)}


axes = {"drag": [0.1, 0.3, 0.6], "ripple": jnp.linspace(20.0, 1200.0, 119)}
options = {"start": vi.State(Y=PLAY / 2, V=0.0), "settle": 200, "cycles": 50, "progress": False}
data = vi.scan(Gears(), axes, measure=vi.Statistics("impact_energy"), **options)
power = 1e3 * INERTIA / RADIUS**2 * data.impact_energy_mean / Gears.cycle
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
power.plot.line(x="ripple", ax=ax)
for drag in axes["drag"]:
    ax.axvline(drag / INERTIA, color="k", ls="--", lw=1)
ax.set(xlabel="ripple of the angular acceleration (rad/s²)", ylabel="power of the rattle (mW)")
figure.savefig("gears.png")
