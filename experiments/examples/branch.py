# %% [markdown]
"""# Continue a motion and switch branches where it bifurcates

The 2π motion is continued in the frequency ratio ζ. At its period doubling a 4π motion with two
impacts begins. At a grazing this motion loses an impact and becomes the paper's 4π motion.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import vi_jax as vi

scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)


# %%
def follow(orbit):
    branch = vi.continue_orbit(orbit, parameter="drive.frequency_ratio", bounds=(0.6, 1.2))
    print(branch)
    return branch, {point.kind: point for point in branch.special}


short, points = follow(vi.find_orbit(scene, scene.start(Y=1.9, V=-0.9)))
two, points = follow(points["period-doubling"].switch())
one, _ = follow(points["grazing"].switch())

# %% Solid: stable; dashed: unstable; marks: special points
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
for branch, name in (short, "2π"), (two, "4π, two impacts"), (one, "4π, one impact"):
    vi.plot_branch(branch, ax=ax, label=name)
ax.set(xlim=(0.69, 1.1), ylim=(-4.2, -1.4), ylabel="lowest position, min Y (a)")
figure.savefig("branch.png")
