"""From a Neimark–Sacker point along quasi-periodic motions to a grazing, past a window of locking.

Two bodies in a row, the first driven against a stop. Below ω = 1.0106 the motion of one cycle is
unstable and a torus attracts. It locks to 1:7 in a narrow window and ends where it grazes the stop.
"""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


class Two(vi.Mechanical):
    q = ("a", "b")
    omega: float = 1.015
    mass = (1.0, 0.5)
    cycle = property(lambda self: 2 * jnp.pi / self.omega)
    contacts = vi.RigidStop(1.1, 0.8, on="a")

    def force(self, t, q, v):
        link = q.a - q.b + 0.05 * (v.a - v.b)
        return dict(a=jnp.cos(self.omega * t - 2) - q.a - 0.1 * v.a - link, b=link)


machine = Two()
settled = vi.simulate(machine, machine.at(a=0.1, b=0.2), 1, settle=300).last
branch = vi.continue_orbit(vi.find_orbit(machine, settled), parameter="omega", bounds=(1.0, 1.02))
torus = branch.special[0].switch(distance=0.3)  # the Neimark–Sacker point
family = vi.continue_torus(torus, parameter="omega", bounds=(0.97, 1.02))
print(family)
figure, (left, middle, right) = plt.subplots(1, 3, figsize=(10, 3.2), layout="constrained")
for omega in (1.005, 0.995, 0.98):
    vi.plot_torus(family.at(omega), ax=left, color=plt.cm.viridis((1.01 - omega) * 30))
vi.plot_torus(family, ax=middle)
vi.plot_torus(family, ax=right, y="exponents")
figure.savefig("torus.png")
