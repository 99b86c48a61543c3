# %% [markdown]
"""# How hard may a motion be kicked?

Two motions of period 4π are stable. The arrows are the smallest kicks after which the machine
settles on the other motion. They end on the boundary of the basins.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import vi_jax as vi

# %% The smallest kick to each motion, applied on the section
scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.02)
kicks = []
for Y, V in ((1.283, 1.007), (1.528, 1.314)):
    orbit = vi.find_orbit(scene, scene.start(Y=Y, V=V), cycles=2)
    kicks.append((orbit, vi.minimal_kick(scene, orbit)))
    print(kicks[-1][1])

# %% The basins of both motions, with the kicks as arrows
region = {"start.Y": (0.9, 1.8), "start.V": (0.7, 1.6)}
found = vi.basins(scene, region, resolution=150, progress=False)
figure, ax = plt.subplots(figsize=(8, 4.6), layout="constrained")
vi.plot_basins(found, ax=ax)
for orbit, kick in kicks:
    there = kick.start.Y, kick.start.V
    tip = {"arrowstyle": "-|>", "lw": 1.8, "shrinkA": 0, "shrinkB": 0, "fc": "k"}
    ax.annotate("", there, (orbit.state.Y, orbit.state.V), arrowprops=tip)
saddle = kicks[0][1].edge.orbit.state
ax.plot(saddle.Y, saddle.V, "kX", ms=9, mec="w")
at = (saddle.Y, saddle.V)
ax.annotate("edge state", at, (-20, 24), textcoords="offset points", color="w")
ax.set_aspect("equal")
ax.set_title(" and ".join(f"{float(kick.norm):.4f}" for _, kick in kicks) + ": the smallest kicks")
figure.savefig("minimal_kick.png")
