# %% [markdown]
"""# An oscillator that grazes its wall

x'' + 0.1 x' + x = A cos ωt, with a wall at x = 1. The motion without impact touches the wall at
A² = (1 - ω²)² + (0.1 ω)².
"""

# %%
import jax
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)


# %% The branch in A ends at the grazing of the wall, which is followed in ω
machine = vi.machines.Duffing(amplitude=0.05, two_sided=False)  # pyright: ignore[reportCallIssue]
orbit = vi.find_orbit(machine, machine.start())
branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.02, 0.3))
(touch,) = (point for point in branch.special if point.kind == "grazing")
curve = vi.boundary(touch, parameter="frequency", bounds=((0.02, 0.6), (0.85, 1.15)))
A, w = curve.parameters.T
apart = np.abs(A - np.hypot(1 - w**2, 0.1 * w)).max()

# %%
comparison = Comparison(
    "COCO",
    "https://sourceforge.net/projects/cocotools; H. Dankowicz and F. Schilder, Recipes for "
    "Continuation, SIAM, 2013, example 15.2",
    "in closed form",
    [
        ("A of grazing, ω = 1", "0.1", touch.parameter, 1e-10),
        ("how far the curve from ω = 0.85 to 1.15 is off", "0", apart, 1e-10),
    ],
)
print(comparison)
