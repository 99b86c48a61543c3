# %% [markdown]
"""# An impactor that makes its base slide

A voltage attracts a body on a spring to a base at q = 0.5. An impact makes the base slide until
friction stops it.
"""

# %%
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% The state: position q and speed of the impactor, and the sliding speed of the base
class Impactor(vi.AbstractMachine):
    cycle: float = 8 * np.pi / 0.92
    events: tuple = (
        vi.Reset(
            lambda machine, s, x, slides: x[0] - 0.5,
            lambda machine, s, x, slides: (x[0], -0.8 * x[1], 0.3 * x[1]),
            modes=lambda *_: (1.0,),
            value=lambda machine, s, x, slides: x[1],
        ),
        vi.Reset(
            lambda machine, s, x, slides: jnp.where(slides > 0, -x[2], -1.0),
            lambda machine, s, x, slides: (x[0], x[1], jnp.zeros_like(x[2])),
            modes=lambda *_: (0.0,),
        ),
    )
    modes = lambda self, s, x: (0.0,)

    def field(self, s, x, slides):
        force = (0.57 * jnp.sin(0.92 * s) / (1 - x[0])) ** 2 - 0.04 * x[1] - x[0]
        return x[1], force + slides * (3.17 + 0.2 * force), slides * (-3.17 - 0.2 * force)


start, close = tuple(map(jnp.array, (0.1, 0.0, 0.0))), vi.Adaptive(rtol=1e-12)
run = vi.simulate(Impactor(), start, 1, event_log=16, method=close)
(time,), (speed,) = run.event_log.phase, run.event_log.value
comparison = Comparison(
    "COCO",
    "H. Dankowicz and F. Schilder, Recipes for Continuation, SIAM, 2013 (stick and slip)",
    "from the equations of the example, at V = 0.57, by SciPy's DOP853 from event to event",
    [
        ("first impact: time", "2.9054088655", time[0], 1e-9),  # published with tolerances of 1e-12
        ("its speed", "0.3200474159", speed[0], 1e-9),
        ("sixth impact: time", "23.1264321092", time[10], 1e-9),
    ],
)
print(comparison)
