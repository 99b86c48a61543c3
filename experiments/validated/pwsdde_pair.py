# %% [markdown]
"""# Two masses, cubic springs and two stops

A forced mass on a cubic spring carries a smaller mass, which hits both ends of its play. At ω = 1.5
the motion is symmetric, with one impact on each side.
"""

# %%
import jax
import jax.numpy as jnp
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% State (x1, x2, x1', x2'); the clock is the phase ωt, and the coordinate is x2 - x1
def placed(z, Y, V):  # keeps the momentum of both; the second has 1/20 of the mass
    far, fast = (Y - z[1] + z[0]) / 1.05, (V - z[3] + z[2]) / 1.05
    return z[0] - 0.05 * far, z[1] + far, z[2] - 0.05 * fast, z[3] + fast


class Pair(vi.AbstractMachine):
    omega: jax.Array | float = 1.5
    contacts: tuple = (vi.RigidStop(1.0, 0.9), vi.RigidStop(1.0, 0.9, "left"))
    cycle: float = 2 * jnp.pi
    coordinates: tuple = (
        vi.Coordinate(lambda z: z[1] - z[0], lambda z: z[3] - z[2], placed, 0.05 / 1.05),
    )

    def field(self, s, z):
        x, y, u, v = z
        pull = 0.952**2 * (x - y) + 0.254 * (u - v) + 0.1 * (x - y) ** 3
        first = jnp.cos(s) - x - 0.04 * u - 0.1 * x**3 - 0.05 * pull
        return tuple(rate / self.omega for rate in (u, v, first, pull))

    def mirrored(self, z):
        return tuple(-x for x in z)


guess = tuple(map(jnp.array, (-0.69, -1.5, 0.13, -1.2)))
orbit = vi.find_orbit(Pair(), guess, method="reference")  # 1e-10 by default
lost = vi.continue_orbit(orbit, parameter="omega", bounds=(1.25, 2.12)).special
WHERE = "1.298963194", "1.439080000", "1.976551861", "2.094953736"
comparison = Comparison(
    "PWSDDE-cont",
    "https://github.com/Tudesz/PWSDDE-cont, `impd_osc_demo.m`",
    "from the equations of the example, by SciPy's DOP853 from event to event and Newton's method",
    [
        ("x1 at phase 0, ω = 1.5", "-0.6861717357", orbit.state[0], 5e-10),
        ("x2", "-1.5139878705", orbit.state[1], 5e-10),
        ("relative speed of impacts", "1.3967862502", orbit.impact_speed[0], 5e-10),
        *((f"ω of the {p.kind}", w, p.parameter, 1e-9) for p, w in zip(lost, WHERE, strict=True)),
    ],
)
print(comparison)
