# %% [markdown]
"""# What a grazing leads to

A strongly damped oscillator, x'' + 10.1 x' + x = cos ωt, touches a stop that comes nearer. Windows
of motions with one impact in n cycles follow, with chaos between.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import vi_jax as vi

frequency = 0.2 * np.pi / np.log(2)
amplitude = 1 / np.hypot(1 - frequency**2, 10.1 * frequency)
machine = vi.machines.Duffing(  # pyright: ignore[reportCallIssue]
    amplitude=1.0, frequency=frequency, damping=10.1, gap=1.1 * amplitude, two_sided=False
)

# %% Where the motion without impact grazes, and what follows
orbit = vi.find_orbit(machine, machine.start())
branch = vi.continue_orbit(orbit, parameter="gap", bounds=(0.9 * amplitude, 1.2 * amplitude))
found = vi.grazing(branch.special[0])
print(found)

# %%
figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
vi.plot_grazing(found, ax=ax, rasterized=True)
ax.set_title("The local map's attractor (dots) over the machine's own (rings)")
figure.savefig("grazing.png")
