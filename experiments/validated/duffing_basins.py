# %% [markdown]
"""# Two Duffing oscillators, and the shares of their basins

x'' + 0.15 x' - x + x³ = 0.2 cos t has a motion in each of its two wells; x'' + 0.08 x' + x³ = 0.2
cos t has five competing motions. `vi.basins` finds them without a list.
"""

# %%
import jax
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)

# %% No stop is near; starts on a grid of 100²
wells = vi.machines.Duffing(  # pyright: ignore[reportCallIssue]
    amplitude=0.2, damping=0.15, stiffness=-1.0, cubic=1.0, gap=100.0
)
single = vi.machines.Duffing(  # pyright: ignore[reportCallIssue]
    amplitude=0.2, damping=0.08, stiffness=0.0, cubic=1.0, gap=100.0
)
wide = {"start.Y": (-2.2, 2.2), "start.V": (-2.2, 2.2)}
narrow = {"start.Y": (-1.0, 1.0), "start.V": (-0.5, 1.0)}
two, five = (
    sorted((motion.period, motion.sections["Y"].min(), motion.fraction) for motion in found)
    for found in (
        vi.basins(wells, wide, resolution=100, settle=200).attractors,
        vi.basins(single, narrow, resolution=100, settle=200).attractors,
    )
)

# %% Their shares have standard errors: 1,000 random starts of the first, 10,000 of the second
within = lambda share, number: 3 * np.sqrt(share * (1 - share) / number)
comparison = Comparison(
    "Attractors.jl; bSTAB, pyBasin",
    "https://github.com/JuliaDynamics/Attractors.jl, `test/mapping/attractor_mapping.jl`; "
    "https://github.com/TUHH-DYN/bSTAB and https://github.com/adrianwix/pyBasin, `duffing`",
    "printed in the test, and in pyBasin's results with bSTAB's; right to three standard errors of "
    "their random starts: 0.05 for the first oscillator, 0.015 for the second",
    [
        ("two wells: motions", "2", len(two)),
        ("share of the left one", "0.488", two[0][2], within(0.488, 1000)),
        ("share of the right one", "0.512", two[1][2], within(0.512, 1000)),
        ("one well: motions", "5", len(five)),
        ("of period 2π, small", "0.2027", five[0][2], within(0.2027, 10000)),
        ("of period 2π, large", "0.495", five[1][2], within(0.495, 10000)),
        ("of period 4π, from x = -0.67", "0.0288", five[2][2], within(0.0288, 10000)),
        ("of period 4π, from x = -0.46", "0.0257", five[3][2], within(0.0257, 10000)),
        ("of period 6π", "0.2478", five[4][2], within(0.2478, 10000)),
    ],
)
print(comparison)
