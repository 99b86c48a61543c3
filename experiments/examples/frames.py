# %% [markdown]
"""# Two frames pound each other, shaken by an unbalanced motor

The motor's speed stays at the resonance (△: run-up), then jumps, sooner if frames collide (blue).
"""

# %%
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi


# %% SI units: frames of 500 and 400 kg at 8 and 10 Hz, an unbalance of 0.2 kg m
class Frames(vi.Mechanical):
    q, cycle = ("near", "far", "phi"), vi.turn_of("phi", usual=0.13)
    gap: float = 0.004
    speed: float = 40.0
    contacts = property(lambda m: vi.RigidStop(m.gap, 0.6, on=lambda q: q.near - q.far))

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        across = -0.2 * jnp.sin(q.phi)
        return [[500.0, 0.0, across], [0.0, 400.0, 0.0], [across, 0.0, 0.1]]

    def force(self, t, q, v):
        near, far = -1.26e6 * q.near - 1000 * v.near, -1.58e6 * q.far - 1000 * v.far
        return {"near": near, "far": far, "phi": 0.1 * (self.speed - v.phi)}


up = jnp.linspace(35.0, 90.0, 56)
figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
for gap, color in ((0.004, "#0072b2"), (1.0, "#d55e00")):
    for values, marker in ((up, "^"), (up[::-1], "v")):
        start = Frames().at(v={"phi": values[0]})
        found = vi.sweep(Frames(gap), "speed", values, start=start, settle=100, cycles=16)
        vi.plot_sweep(found, ax=ax, y="frequency_ratio", marker=marker, color=color, mfc="none")
ax.set(xlabel="speed that the motor is set to (rad/s)", ylabel="mean speed (rad/s)")
figure.savefig("frames.png")
