# %% [markdown]
"""# How safe is a motion: the erosion of basins

Each motion is drawn over the frequency ratio ζ with its share of the starts, and with the radius of
the largest ball of starts around it that all return. At ζ = 1.56 a basin is gone.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import vi_jax as vi

# %% The same starts at 27 values of ζ, one compiled program
scene = vi.Scene.ideal(frequency_ratio=1.3, restitution=0.8, gap=2.0, damping_ratio=0.05)
region = {"start.Y": (-8.0, 2.0), "start.V": (-8.0, 10.0)}
profile = vi.integrity_profile(
    scene, "drive.frequency_ratio", np.linspace(1.0, 1.65, 27), region,
    resolution=(40, 72), settle=400, progress=False,
)  # fmt: skip
print(profile)

# %% At one value: what the boundary of the basins is like
at = int(np.argmin(np.abs(profile.values - 1.4)))
print(profile.basins[at].entropy(), profile.basins[at].uncertainty().exponent)

# %%
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
vi.plot_integrity(profile, y="share", ax=axes[0])
vi.plot_integrity(profile, y="local", ax=axes[1])
axes[0].set_title("Share of the starts")
axes[1].set_title("Kick that the motion survives")
axes[1].legend(loc=(0.38, 0.76), fontsize="small", frameon=False)
figure.savefig("integrity.png")
