# %% [markdown]
"""# Boundaries in two parameters

Two curves are followed over the frequency ratio ζ and the restitution k: the period doubling of the
2π motion, and the grazing at which the 4π motion ends.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import vi_jax as vi

scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
bounds = ((0.7, 1.02), (0.05, 0.95))


# %% Continue each motion in ζ, then follow its first special point of a kind in ζ and k
def curve(Y, V, cycles, kind):
    orbit = vi.find_orbit(scene, scene.start(Y=Y, V=V), cycles=cycles)
    branch = vi.continue_orbit(orbit, parameter="drive.frequency_ratio", bounds=bounds[0])
    point = next(point for point in branch.special if point.kind == kind)
    return vi.boundary(point, parameter="stops.0.restitution", bounds=bounds)


doubling = curve(1.9, -0.9, 1, "period-doubling")
grazing = curve(1.6, -1.9, 2, "grazing")
print(doubling, grazing, sep="\n")

# %%
figure, ax = plt.subplots(figsize=(7, 4), layout="constrained")
vi.plot_boundary(doubling, ax=ax, label="2π motion doubles its period")
vi.plot_boundary(grazing, ax=ax, label="4π motion ends by a grazing")
ax.plot(0.9, 0.5, "k*", ms=11, label="the paper's Figures 3 and 4")
ax.set_title("No damping: left of the dashed line the 2π motion is unstable")
ax.legend(loc="lower right", frameon=False)
figure.savefig("boundary.png")
