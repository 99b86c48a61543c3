# %% [markdown]
"""# Delayed feedback ends the chaos of an impact oscillator

A driven oscillator strikes a stop at its rest position and moves chaotically. A force that is g
times (velocity one cycle ago - velocity) makes it repeat: from g = 0.12 after four cycles.
"""

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

jax.config.update("jax_enable_x64", True)


class Controlled(vi.AbstractMachine):
    gain: float = 0.0
    cycle = 2 * jnp.pi / 2.75
    contacts = vi.RigidStop(0.0, 0.8, on=("x", "u"))
    delays = property(lambda m: {"cycle": m.cycle})

    def field(self, t, z, past):
        feedback = self.gain * (past.cycle.u - z.u)
        return {"x": z.u, "u": jnp.cos(2.75 * t) - z.x + feedback}


gains = jnp.linspace(0.0, 0.3, 301)
start = vi.State(x=-0.1, u=0.0)
data = vi.scan(Controlled(), {"gain": gains}, measure="sections", start=start, settle=300)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
ax.plot(data.gain, data.u, "k.", markersize=1)
ax.set(xlabel="gain g of the feedback", ylabel="velocity once in each cycle")
figure.savefig("delayed_control.png")
