# %% [markdown]
"""# A vibro-impact energy sink flattens a resonance

A 100 g ball in a 10 kg machine absorbs energy by one impact per side and cycle (dotted: no ball).
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


# %% SI units; the machine without the ball has its resonance at 5 Hz
class Sink(vi.Mechanical):
    q, mass = ("body", "ball"), (10.0, 0.1)
    frequency: float = 5.0
    cycle = property(lambda machine: 1 / machine.frequency)
    contacts = tuple(
        vi.RigidStop(0.01, 0.6, side, on=lambda q: q.ball - q.body) for side in ("right", "left")
    )

    def force(self, t, q, v):
        push = 1.23 * jnp.cos(2 * jnp.pi * t / self.cycle)
        return {"body": push - 9870 * q.body - 3.14 * v.body, "ball": 0.0}

    def averages(self, t, z):
        return {"square": z.body**2}


last = vi.simulate(Sink(), Sink().at(body=0.005), 1, settle=600).last
branch = vi.continue_orbit(vi.find_orbit(Sink(), last), parameter="frequency", bounds=(4.5, 5.5))
omega = 2 * jnp.pi * jnp.linspace(4.5, 5.5, 401)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
ax.semilogy(omega / 2 / jnp.pi, (1.23 / abs(9870 - 10 * omega**2 + 3.14j * omega)) ** 2 / 2, "k:")
vi.plot_branch(branch, ax=ax, y="square")
ax.set(xlabel="frequency (Hz)", ylabel="mean square of the displacement (m²)")
figure.savefig("energy_sink.png")
