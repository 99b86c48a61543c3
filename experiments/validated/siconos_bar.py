# %% [markdown]
"""# An elastic bar that hits a wall

A steel bar of 100 nodes hits a wall at 0.1 m/s. Its end stays in contact until the wave in the bar
returns. The wall is a stop without restitution, and the bar is simulated in its natural modes.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)
# %% Linear elements with consistent mass, of 1 cm each (kg, N/m)
n, element, youngs, density, section = 100, 0.01, 210e9, 7800.0, 3.14e-4
mass = np.diag(np.full(n, 2 / 3)) + (np.eye(n, k=1) + np.eye(n, k=-1)) / 6
stiffness = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
mass[0, 0] = mass[-1, -1] = 1 / 3
stiffness[0, 0] = stiffness[-1, -1] = 1.0
mass *= density * section * element
bar = vi.machines.Structure(  # pyright: ignore[reportCallIssue]
    mass=mass, stiffness=youngs * section / element * stiffness,
    contacts=(vi.RigidStop(0.0, 0.0, "left", at=np.eye(n)[0]),), frequency=2 * np.pi / 1.5e-3,
)  # fmt: skip
start = vi.machines.StructureState(jnp.full(n, 5e-5), jnp.full(n, -0.1))
run = vi.simulate(bar, start, 1, event_log=8)
# No force presses the undeformed end on its stop: rounding may make it hop once, for 1e-9 s.
strikes, leaves = jnp.nanmin(run.event_log.phase), jnp.nanmax(run.event_log.phase)
impulse = np.ones(n) @ mass @ (np.asarray(run.last.velocity) + 0.1)

# %% Their times are known to some steps of 2e-6 s
wave = np.sqrt(youngs / density)
comparison = Comparison(
    "Siconos",
    "https://github.com/siconos/siconos-tutorials, `examples/mechanics/FEM/ImpactingBar`",
    "printed in the reference file of its test, from time stepping at 2e-6 s; the force by the "
    "theory of waves, EA v/c, from which 99 elements differ by 0.1 %",
    [
        ("contact begins (ms)", "0.504", 1e3 * strikes, 0.01),
        ("contact ends (ms)", "0.886", 1e3 * leaves, 0.01),
        ("impulse of the wall (N s)", "0.481427", impulse, 5e-4),
        ("mean force (N)", f"{youngs * section * 0.1 / wave:.2f}", impulse / (leaves - strikes), 2),
    ],
)
print(comparison)
