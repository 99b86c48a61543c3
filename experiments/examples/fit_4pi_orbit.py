# %% [markdown]
"""# Initial conditions without a transient, fitted with optax

From the right initial state, the machine is in its stable 4π motion at once. Adam minimises the
change over two cycles, with gradients through the impacts. Newton's method needs five steps.
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import matplotlib.pyplot as plt
import optax
import vi_jax as vi

scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
guess = scene.start(Y=1.3, V=0.8)

# %% The loss: half the squared distance between the state and the state two drive cycles later
adam = vi.Gradient(optax.adam(optax.cosine_decay_schedule(0.02, 600)), max_steps=600)
fitted = vi.find_orbit(scene, guess, cycles=2, root_finder=adam)
newton = vi.find_orbit(scene, guess, cycles=2)
for name, orbit in (("Adam", fitted), ("Newton", newton)):
    Y, V, missing = orbit.state.Y, orbit.state.V, float(orbit.residual)
    print(f"{name}: Y = {Y:.7f}, V = {V:.7f}, {orbit.iterations} steps, residual {missing:.0e}")

# %% From rest and from the fitted state
rest, there = (vi.simulate(scene, start, 60) for start in (scene.start(), fitted.state))
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left.semilogy(fitted.history, color="#d55e00", label="Adam")
left.semilogy(newton.history, "o-", color="#0072b2", ms=4, label="Newton")
left.set(xlabel="step", ylabel="largest residual (a, a ω)", title="The search")
right.plot(rest.y_min, ".", color="0.4", label="from rest")
right.plot(there.y_min, "+", color="#d55e00", ms=7, label="from the fitted state")
right.set(xlabel="drive cycle", ylabel="least Y (a)", title="4π: two minima in turn")
for ax in (left, right):
    ax.legend(frameon=False)
figure.savefig("fit_4pi_orbit.png")
