# %% [markdown]
"""# Chatter in turning, and a ball that limits it

The force on a tool depends on the surface that it left one turn ago. It chatters if the cut is
stiffer (dotted) than the lobes of linear theory (dashed). A ball in a slot of the tool takes energy.
"""

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import vi_jax as vi

jax.config.update("jax_enable_x64", True)
Z, K, SLOTS = 0.03, 0.15, {1e3: "tool", 0.5: "tool with a ball"}  # damping, stiffness of the cut


class Tool(vi.Mechanical):
    q, mass, before = ("x", "ball"), (1.0, 0.06), vi.State(s=0.0)
    slot: float = 0.5
    turn: float = 8.0
    cycle, delays = property(lambda m: m.turn), property(lambda m: {"turn": m.turn})
    events = vi.Switch(lambda m, t, z, past: 1 + past.turn.s - z.x)  # the feed is 1 in a turn
    stop = lambda m, side: vi.RigidStop(m.slot, 0.6, side, on=lambda q: q.ball - q.x)
    contacts = property(lambda m: (m.stop("right"), m.stop("left")))
    recorded = lambda m, t, z, past, cuts: {"s": jnp.where(cuts > 0, z.x, past.turn.s + 1)}

    def force(self, t, q, v, past, cuts):
        chip = jnp.where(cuts > 0, 1 + past.turn.s - q.x, 0.0)
        return {"x": K * chip - 2 * Z * v.x - q.x, "ball": 0.0}


speeds, (figure, ax) = jnp.linspace(0.45, 1.15, 36), plt.subplots(layout="constrained")
axes = {"slot": [*SLOTS], "turn": 2 * jnp.pi / speeds}
data = vi.scan(Tool(), axes, measure="extremes", settle=100, cycles=20)
ax.plot(speeds, (data.y_max - data.y_min).T, ".-", label=[*SLOTS.values()])
ax.set(xlabel="turns in a natural period", ylabel="range of x (feeds)", xlim=(0.45, 1.15))
W = jnp.linspace(1.03, 1.35, 400)  # the frequency of chatter on a lobe
limit = ((W**2 - 1) ** 2 + (2 * Z * W) ** 2) / (2 * (W**2 - 1))
turns = jnp.arctan2(-2 * Z * W, 1 + limit - W**2) / (2 * jnp.pi) + jnp.arange(1, 4)[:, None]
ax.twinx().plot((W / turns).T, limit, "k--", [0.45, 1.15], [K, K], "C3:")
ax.legend(loc="upper left")
figure.savefig("turning.png", dpi=100)
