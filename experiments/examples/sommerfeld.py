# %% [markdown]
"""# A weak motor hangs at resonance: the Sommerfeld effect

A weak motor shakes a body that does not reach its stop. Near resonance (ζ = 1) the body takes up
the power: the speed ζ hardly rises with the control κ, then jumps.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

scene = vi.Parameters(torque=0.5, gap=0.8).scene(drive="motor")
kappas = jnp.linspace(0.5, 3.0, 101)

# %% Run-up and close-down side by side, in one compiled call
both = jnp.stack([kappas, kappas[::-1]])
up_and_down = vi.jit(jax.vmap(lambda values: vi.sweep(scene, "drive.control", values)))(both)
up, down = (jax.tree.map(lambda x, i=i: x[i], up_and_down) for i in (0, 1))
print(up)

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for ax, y in zip(axes, ("frequency_ratio", "y_max"), strict=True):
    vi.plot_sweep(up, ax=ax, y=y, marker="^", color="#0072b2", label="κ rising")
    vi.plot_sweep(down, ax=ax, y=y, marker="v", color="#d55e00", label="κ falling")
axes[0].plot(kappas, kappas, "k:", lw=1, label="ζ = κ, an ideal drive")
axes[0].set(ylabel="crank speed ζ (ω)", title="the crank hangs at ζ = 1")
axes[1].set(ylabel="highest position, max Y (a)", title="amplitude of the body")
axes[0].legend(frameon=False)
figure.savefig("sommerfeld.png")
