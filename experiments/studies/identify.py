# %% [markdown]
# # Identifying a stop from a noisy record of the motion
#
# An impacting body is watched for ten drive cycles: 320 noisy positions Y(φ), 30 dB signal to
# noise. From them are to be found the restitution k, the damping ratio ξ, the gap d and the state
# (Y0, V0) at which the record begins. The derivatives by the five unknowns go through every impact,
# so that Levenberg–Marquardt works as on a smooth model, and the Jacobian at the estimate gives
# standard errors. Whether these are honest is tested by many records in one `vmap`.
#
# Run with `python experiments/studies/identify.py` (`--quick` for fewer records).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import vi_jax as vi

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, write
from tools.tables import table

RECORDS = 16 if QUICK else 256
CYCLES, SAMPLES, DECIBELS = 10, 32, 30.0
NAMES = ("k", "ξ", "d", "Y0", "V0")
TRUTH = jnp.array([0.5, float(vi.Parameters().scene().damping_ratio), 1.2, 0.0, 0.0])
GUESS = jnp.array([0.7, 0.08, 1.35, 0.1, 0.1])


def positions(unknowns: Any) -> Any:
    """Return the positions of a record without noise, `(320,)`."""
    k, xi, d, Y, V = unknowns
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=d, damping_ratio=xi)
    start = scene.start(Y=Y, V=V)
    run = vi.simulate(scene, start, CYCLES, method=vi.ExactFlight(), samples=SAMPLES)
    assert run.samples is not None
    return run.samples.state.Y[1:]


def missing(unknowns: Any, data: Any) -> Any:
    """Return what the model leaves over of a record."""
    return positions(unknowns) - data


def fit(data: Any) -> tuple[Any, Any, Any]:
    """Return the estimate, its standard errors, and the residual's standard deviation."""
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    solution = optx.least_squares(
        missing, solver, GUESS, data, options={"jac": "fwd"}, max_steps=100, throw=False
    )
    variance = jnp.sum(missing(solution.value, data) ** 2) / (data.size - GUESS.size)
    jacobian = jax.jacfwd(positions)(solution.value)
    errors = jnp.sqrt(variance * jnp.diag(jnp.linalg.inv(jacobian.T @ jacobian)))
    return solution.value, errors, jnp.sqrt(variance)


# %% [markdown]
# ## Many records, and whether the standard errors are honest

# %%
clean = jax.jit(positions)(TRUTH)
noise = float(jnp.std(clean)) * 10 ** (-DECIBELS / 20)
records = clean + noise * jax.random.normal(jax.random.key(1), (RECORDS, clean.size))
# In batches, so that no record waits for the slowest of all the others.
fits = vi.jit(lambda x: jax.lax.map(fit, x, batch_size=16))
estimates, errors, scatter = (np.asarray(x) for x in fits(records))
truth, found = np.asarray(TRUTH), scatter < 1.25 * noise
covered = np.abs(estimates - truth)[found] < 1.96 * errors[found]
jacobian = np.asarray(jax.jit(jax.jacfwd(positions))(TRUTH))
covariance = np.linalg.inv(jacobian.T @ jacobian)
correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
heads = [
    "", "true", "first guess", "estimate, first record", "its standard error",
    "mean of all estimates", "their spread", "mean standard error", "within ±1.96 errors",
]  # fmt: skip
rows = [
    [
        name, f"{truth[i]:.5f}", f"{GUESS[i]:g}", f"{estimates[0, i]:.5f}", f"{errors[0, i]:.5f}",
        f"{estimates[found, i].mean():.5f}", f"{estimates[found, i].std(ddof=1):.5f}",
        f"{errors[found, i].mean():.5f}", f"{covered[:, i].mean():.1%}",
    ]
    for i, name in enumerate(NAMES)
]  # fmt: skip
text = f"""# Identifying a stop from a noisy record of the motion

Ideal drive, ζ = 0.9, {CYCLES} cycles, {clean.size} positions with noise of {noise:.4f} a
({DECIBELS:g} dB below the signal's standard deviation); lengths in units of a, V0 in units of aω.
{RECORDS} records, each fitted from the same first guess by Levenberg–Marquardt;
{int(found.sum())} of the fits ended at the noise.

{table(heads, rows)}

The share of estimates within 1.96 standard errors differs from 95 % by no more than chance makes.
The errors of k and ξ go together (correlation {correlation:.2f}), since both take energy from the
motion. Posteriors of the same three numbers, from shorter records: [`posterior`](posterior.md).
"""
print(text)
numbers = {f"{name}, first record": float(estimates[0, i]) for i, name in enumerate(NAMES)}
numbers |= {"k and ξ: correlation": correlation, "noise": noise}
write("identify", text, numbers)
