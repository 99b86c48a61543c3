# %% [markdown]
"""# How long does a motion last where everything shakes?

White noise ends the stable 4π motion sooner or later. Left: 1,024 runs on sections. Right: the time
until they leave.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import numpy as np
import vi_jax as vi


# %% Of two cycles beside each other one is deep, until the motion is lost
def depth(machine, run):
    return jax.numpy.minimum(run.y_min[1:], run.y_min[:-1])


scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
orbit = vi.find_orbit(scene, scene.start(Y=1.283, V=1.007), cycles=2)
noise = vi.WhiteNoise({"V": 0.008}, impulses=32)
shaken = {"start": orbit.state, "settle": 0, "noise": noise, "key": jax.random.key(1)}
bins = vi.Density({"Y": np.linspace(1.1, 1.8, 141), "V": np.linspace(0.8, 1.5, 141)})
seen = vi.scan(scene, {"noise.path": range(1024)}, measure=bins, cycles=600, **shaken)
axes = {"noise.V": 0.01 / np.sqrt(np.linspace(1, 2.5, 7)), "noise.path": range(512)}
left = vi.scan(scene, axes, measure=vi.Escape(depth, high=-2.88), cycles=600, **shaken)
found = vi.escape_rate(left, "noise.path", after=10)
figure, (states, rates) = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
density = np.log10(np.maximum(seen.density.mean("noise.path").T, 1e-3))
picture = states.imshow(density, origin="lower", extent=(1.1, 1.8, 0.8, 1.5))
states.set(xlabel="Y/a", ylabel="V/(aω)", title="Where it is, on sections: σ = 0.008 aω$^{3/2}$")
figure.colorbar(picture, ax=states, label="log$_{10}$ of the density in 1/(a²ω)")
bars = abs(np.stack([found.rate_low, found.rate_high]) - found.rate.values)
rates.errorbar(1e-4 * found["noise.V"] ** -2, found.rate, bars, fmt="o", capsize=3)
rates.set(yscale="log", xlabel="10⁻⁴ a²ω³/σ²", ylabel="exits per cycle", title="How soon it goes")
figure.savefig("noise.png")
