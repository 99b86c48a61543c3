# %% [markdown]
"""# From a Neimark–Sacker point along quasi-periodic motions to a grazing

Two bodies in a row; a stop limits the driven one. Below ω = 1.0106 a torus attracts. It locks to
1:7 in a narrow window (orange) and ends where it grazes the stop. Left: its curve on the section.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


class Row(vi.Mechanical):
    q, mass = ("a", "b"), (1.0, 0.5)
    omega: float = 1.015
    cycle = property(lambda self: 2 * jnp.pi / self.omega)
    contacts = vi.RigidStop(1.1, 0.8, on="a")

    def force(self, t, q, v):
        link = q.a - q.b + 0.05 * (v.a - v.b)
        return dict(a=jnp.cos(self.omega * t - 2) - q.a - 0.1 * v.a - link, b=link)


row, span = Row(), {"parameter": "omega", "bounds": (0.97, 1.02)}
settled = vi.simulate(row, row.at(a=0.1, b=0.2), 1, settle=300).last
branch = vi.continue_orbit(vi.find_orbit(row, settled), **span)
family = vi.continue_torus(branch.special[0].switch(distance=0.3), **span)
print(family)

# %%
figure, (left, middle, right) = plt.subplots(1, 3, figsize=(11, 3.5), layout="constrained")
for omega, color in ((1.005, "C0"), (0.995, "C2"), (0.98, "C3")):
    vi.plot_torus(family.at(omega), ax=left, color=color)
vi.plot_torus(family, ax=middle)
vi.plot_torus(family, ax=right, y="exponents")
figure.savefig("torus.png")
