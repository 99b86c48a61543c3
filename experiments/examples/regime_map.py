# %% [markdown]
"""# A map of the regimes of motion

`scan` simulates all combinations of the values on the axes, here 96 × 64 machines from rest, and
classifies each final motion: a period, in drive cycles of 2π, or chaos.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.01)

# %% With store="map.zarr" it would survive an interruption and go on where it was
data = vi.scan(
    scene,
    {
        "drive.frequency_ratio": jnp.linspace(0.66, 1.02, 96),
        "stops.0.restitution": jnp.linspace(0.02, 0.98, 64),
    },
    measure=("regime", "extremes"),
    settle=400,
    progress=False,
)
share = float((data["period"] == 2).mean())
print(f"{100 * share:.0f} % of the machines settle on a 4π motion")

# %%
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
vi.plot_regimes(data, ax=ax)
ax.set_title("What a start at rest settles on, ξ = 0.01")
figure.savefig("regime_map.png")
