# %% [markdown]
"""# Your own machine

A pendulum leans against a wall, its pivot is shaken up and down, and a second wall limits its
swing. The class defines stops, a cycle, a field and a start.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


# %% Angle Y, positive towards the first wall (which lies beyond the vertical: its gap is negative)
class Pendulum(vi.AbstractMachine):
    shaking: jax.Array | float = 1.0
    contacts: tuple[vi.RigidStop, ...] = (vi.RigidStop(-0.2, 0.8), vi.RigidStop(1.5, 0.8, "left"))

    @property
    def cycle(self):
        return jnp.pi

    def field(self, s, state):
        pull = 1 + self.shaking * jnp.cos(2 * s)
        return vi.OscillatorState(state.V, -0.1 * state.V - pull * jnp.sin(state.Y))

    def start(self):
        return vi.OscillatorState(jnp.array(-0.5), jnp.array(0.0))


# %% Where it is after each cycle, for 600 strengths of the shaking
axis = jnp.linspace(0.5, 2.5, 600)
data = vi.scan(Pendulum(), {"shaking": axis}, measure="sections", settle=400, progress=False)
figure, ax = plt.subplots(figsize=(8, 3.8), layout="constrained")
ax.plot(axis, data["Y"], ".", color="#0072b2", ms=1.5)
ax.set(xlabel="acceleration of the pivot (g)", ylabel="angle after each cycle (rad)")
figure.savefig("own_machine.png")
