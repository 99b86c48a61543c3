# %% [markdown]
"""# Fit restitution, damping and gap to a noisy record

The Gauss–Newton method, with derivatives through the impacts, gives estimates and standard errors.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


# %% Positions of the body over six cycles from rest, 32 samples per cycle; x holds k, ξ and d
def positions(x):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=x[0], gap=x[2], damping_ratio=x[1])
    run = vi.simulate(scene, scene.start(), cycles=6, samples=32)
    return run.samples.state.Y  # pyright: ignore


truth, guess = jnp.array([0.5, 0.045, 1.2]), jnp.array([0.75, 0.1, 1.5])
record = positions(truth) + 0.05 * jax.random.normal(jax.random.key(0), (193,))

# %% Gauss–Newton steps, and standard errors from the last Jacobian
value, slopes, x = vi.jit(positions), vi.jit(jax.jacfwd(positions)), guess
for _ in range(12):
    x = x + jnp.linalg.lstsq(slopes(x), record - value(x))[0]
errors = 0.05 * jnp.sqrt(jnp.diag(jnp.linalg.inv(slopes(x).T @ slopes(x))))
for name, *row in zip(("k", "ξ", "d"), truth, guess, x, errors, strict=True):
    print("{}: true {:.4f}, guessed {:.4f}, fitted {:.4f} ± {:.4f}".format(name, *row))
cycles = jnp.arange(193) / 32
figure, ax = plt.subplots(figsize=(8, 3.6), layout="constrained")
ax.plot(cycles, record, ".", color="0.4", ms=4, label="record")
ax.plot(cycles, value(guess), "--", color="#d55e00", lw=1.4, label="first guess")
ax.plot(cycles, value(x), color="#0072b2", lw=1.4, label="fit")
ax.set(xlabel="drive cycles", ylabel="position Y (a)")
ax.legend(frameon=False)
figure.savefig("fit.png")
