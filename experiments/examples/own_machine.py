# %% [markdown]
"""# Your own machine

A pendulum leans against a wall, its pivot is shaken up and down, and a second wall limits its
swing. The class defines parameters, a cycle, contacts, a field and a start.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


# %% The angle is positive towards the first wall, which lies beyond the vertical (negative gap)
class Pendulum(vi.AbstractMachine):
    shaking: float = 1.0
    cycle = jnp.pi
    contacts = (
        vi.RigidStop(-0.2, 0.8, on=("angle", "rate")),
        vi.RigidStop(1.5, 0.8, "left", on=("angle", "rate")),
    )

    def field(self, t, z):
        pull = 1 + self.shaking * jnp.cos(2 * t)
        return {"angle": z.rate, "rate": -0.1 * z.rate - pull * jnp.sin(z.angle)}

    def start(self):
        return vi.State(angle=-0.5, rate=0.0)


# %% Where it is after each cycle, for 600 strengths of the shaking
axis = jnp.linspace(0.5, 2.5, 600)
data = vi.scan(Pendulum(), {"shaking": axis}, measure="sections", settle=400, progress=False)
figure, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
ax.plot(axis, data["angle"], ".", color="#0072b2", ms=1.5)
ax.set(xlabel="acceleration of the pivot (g)", ylabel="angle after each cycle (rad)")
figure.savefig("own_machine.png")
