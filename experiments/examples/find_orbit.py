# %% [markdown]
"""# Find periodic motions, stable or not

`find_orbit` solves for a motion that repeats. Here it finds the stable 4π motion, and the 2π motion
with a Floquet multiplier outside the unit circle.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import vi_jax as vi

scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)

# %% Newton's method on the map of one and of two drive cycles
short = vi.find_orbit(scene, scene.start(Y=1.9, V=-0.9), cycles=1)
long = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2)
print(short)
print(long)

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.9), layout="constrained")
for orbit, color, name in ((short, "#0072b2", "2π, unstable"), (long, "#e69f00", "4π, stable")):
    vi.plot_phase_portrait(orbit.trajectory(), scene, ax=left, lw=1.5, color=color, label=name)
    vi.plot_multipliers(orbit, ax=right, color=color)
left.set(xlabel="position Y (a)", ylabel="velocity V (a ω)", title="dots: after each drive cycle")
left.set_ylim(-2.8, 5.4)
left.legend(loc="upper left", frameon=False, ncols=2)
right.set_title("Floquet multipliers and the unit circle")
figure.savefig("find_orbit.png")
