# %% [markdown]
"""# Chatter in turning, and a ball that limits it

A tool chatters if its cut is stiffer (dotted) than the lobes of linear theory allow (dashed).
"""

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

jax.config.update("jax_enable_x64", True)
Z, K, W = 0.03, 0.15, 1 + jnp.geomspace(0.002, 0.35, 400)  # damping, stiffness, frequencies


class Tool(vi.Mechanical):
    q, mass, before = ("x", "ball"), (1.0, 0.06), vi.State(s=0.0)
    slot: float = 0.5
    turn: float = 8.0
    cycle, delays = property(lambda m: m.turn), property(lambda m: {"turn": m.turn})
    events = vi.Switch(lambda m, t, z, past: 1 + past.turn.s - z.x)  # the feed is 1 in a turn
    stop = lambda m, side: vi.RigidStop(m.slot, 0.6, side, on=lambda q: q.ball - q.x)
    contacts = property(lambda m: (m.stop("right"), m.stop("left")))
    recorded = lambda m, t, z, past, cuts: {"s": jnp.where(cuts > 0, z.x, past.turn.s + 1)}
    averages = lambda m, t, z, past, cuts: {"square": z.v.x**2}

    def force(self, t, q, v, past, cuts):
        cut = K * jnp.where(cuts > 0, 1 + past.turn.s - q.x, 0.0)
        return {"x": cut - 2 * Z * v.x - q.x, "ball": 0.0}


speeds, (figure, ax) = jnp.linspace(0.45, 1.15, 36), plt.subplots(figsize=(8, 4))
data = vi.scan(Tool(), {"slot": [1e3, 0.5], "turn": 2 * jnp.pi / speeds}, measure="square")
ax.plot(speeds, data.square.T**0.5, ".-")
ax.set(xlabel="turns in a natural period", ylabel="rms velocity (orange: ball)", xlim=(0.45, 1.15))
limit = (W**2 - 1) / 2 + (2 * Z * W) ** 2 / (2 * (W**2 - 1))
turns = jnp.arctan2(-2 * Z * W, 1 + limit - W**2) / (2 * jnp.pi) + jnp.arange(1, 4)[:, None]
ax.twinx().plot((W / turns).T, limit, "k--", [0.45, 1.15], [K, K], "C3:")
figure.savefig("turning.png")
