# %% [markdown]
"""# Basins of attraction: which start goes where

With little damping (ξ = 0.004) several stable motions compete at the same parameters. `basins`
simulates a grid of starts and finds these motions without a list of them.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
from math import pi

import matplotlib.pyplot as plt
import vi_jax as vi

# %% Observed half a turn after the crank's outer position, where no impact falls on the section
scene = vi.Scene.ideal(frequency_ratio=3.2, restitution=0.9, gap=1.05, damping_ratio=0.004)
scene = scene.at_section(pi)
region = {"start.Y": (-3.5, 1.05), "start.V": (-4.0, 4.0)}
found = vi.basins(scene, region, resolution=96, settle=1600, tolerance=1e-5, progress=False)
print(found)

# %%
figure, ax = plt.subplots(figsize=(8, 4.6), layout="constrained")
vi.plot_basins(found, ax=ax)
ax.set_title("Start and the motion it settles on")
figure.savefig("basins.png")
