# %% [markdown]
# # Identifying a stop from a noisy record of the motion
#
# An impacting body is watched for ten drive cycles: 320 noisy positions Y(φ), 30 dB signal to
# noise. From them are to be found the restitution k, the damping ratio ξ and the gap d, and with
# them the state (Y0, V0) at which the record begins, which nobody measured without noise either.
# The frequency ratio of the ideal drive, ζ = 0.9, is known.
#
# The model is `simulate(..., samples=32)`. Its derivatives by the five unknowns go through every
# impact (`jax.jacfwd`), so that Levenberg–Marquardt works as it would on a smooth model, and the
# Jacobian at the estimate gives standard errors. Whether these are honest is tested by repeating
# the whole estimate, from the same poor first guess, for many records in one `vmap`.
#
# Run with `python experiments/studies/identify.py` (`--quick` for fewer records).

# %%
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import vi_jax as vi
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from vi_jax.plot.colors import BLUE, ORANGE, RED, STOP, paler

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, write
from tools.tables import table

RECORDS = 16 if QUICK else 256
CYCLES, SAMPLES, DECIBELS = 10, 32, 30.0
NAMES = ("k", "ξ", "d", "Y0", "V0")
TRUTH = jnp.array([0.5, float(vi.Parameters().scene().damping_ratio), 1.2, 0.0, 0.0])
GUESS = jnp.array([0.7, 0.08, 1.35, 0.1, 0.1])
# Random first guesses are drawn from here.
LOW, HIGH = jnp.array([0.1, 0.0, 0.8, -0.5, -0.5]), jnp.array([0.9, 0.15, 1.8, 0.5, 0.5])
BEGUN = time.perf_counter()

# %% [markdown]
# ## Model, noise and fit


# %%
def scene_of(unknowns: Any) -> vi.Scene:
    k, xi, d, _, _ = unknowns
    return vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=d, damping_ratio=xi)


def motion(unknowns: Any) -> vi.Run:
    scene, (*_, Y, V) = scene_of(unknowns), unknowns
    return vi.simulate(
        scene, scene.start(Y=Y, V=V), CYCLES, method=vi.ExactFlight(), samples=SAMPLES, impact_log=8
    )  # fmt: skip


def positions(unknowns: Any) -> Any:
    samples = motion(unknowns).samples
    assert samples is not None
    return samples.state.Y[1:]


def missing(unknowns: Any, data: Any) -> Any:
    return positions(unknowns) - data


def fit(data: Any, guess: Any) -> tuple[Any, Any, Any, Any]:
    """Estimate, its standard errors, the residual's standard deviation, and steps taken."""
    solver = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    solution = optx.least_squares(
        missing, solver, guess, data, options={"jac": "fwd"}, max_steps=100, throw=False
    )
    estimate = solution.value
    left = missing(estimate, data)
    variance = jnp.sum(left**2) / (left.size - guess.size)
    jacobian = jax.jacfwd(positions)(estimate)
    covariance = variance * jnp.linalg.inv(jacobian.T @ jacobian)
    errors = jnp.sqrt(jnp.diag(covariance))
    return estimate, errors, jnp.sqrt(variance), solution.stats["num_steps"]


# %% [markdown]
# ## Many records at once
#
# `jax.lax.map` with a batch size, so that no record waits for the slowest of all the others.

# %%
true_run = jax.jit(motion)(TRUTH)
clean = jax.jit(positions)(TRUTH)
noise = float(jnp.std(clean)) * 10 ** (-DECIBELS / 20)
records = clean + noise * jax.random.normal(jax.random.key(1), (RECORDS, clean.size))
impacts = int(jnp.sum(true_run.impacts))
print(f"{impacts} impacts in {CYCLES} cycles, noise of {noise:.4f}")

begun = time.perf_counter()
fits = vi.jit(lambda *x: jax.lax.map(lambda x: fit(*x), x, batch_size=16))
guesses = jnp.tile(GUESS, (RECORDS, 1))
compiled = fits.lower(records, guesses).compile()
compile_seconds = time.perf_counter() - begun
begun = time.perf_counter()
estimates, errors, scatter, steps = (np.asarray(x) for x in compiled(records, guesses))
seconds = time.perf_counter() - begun
print(f"{RECORDS} fits in {seconds:.1f} s after {compile_seconds:.1f} s of compilation")

# %% [markdown]
# ## Are the standard errors honest?
#
# The first test is on the fit: a search that ended elsewhere leaves more than noise behind. The
# second one is on the errors: deviations from the truth in units of the standard error should
# have unit spread, and 95 % of them should be smaller than 1.96.

# %%
truth = np.asarray(TRUTH)
found = scatter < 1.25 * noise
units = ((estimates - truth) / errors)[found]
covered = np.abs(units) < 1.96
slack = 1.96 * np.sqrt(0.95 * 0.05 / found.sum())
heads = [
    "", "true", "first guess", "estimate, first record", "its standard error",
    "mean of all estimates", "their spread", "mean standard error", "within ±1.96 errors",
]  # fmt: skip
rows = []
for i, name in enumerate(NAMES):
    one, all_ = estimates[0, i], estimates[found, i]
    mean, spread = all_.mean(), all_.std(ddof=1)
    numbers = (one, errors[0, i], mean, spread, errors[found, i].mean())
    cells = [f"{truth[i]:.5f}", f"{float(GUESS[i]):g}", *(f"{x:.5f}" for x in numbers)]
    rows.append([name, *cells, f"{covered[:, i].mean():.1%}"])
unknowns = table(heads, rows)
print(unknowns)


jacobian = np.asarray(jax.jit(jax.jacfwd(positions))(TRUTH))
covariance = np.linalg.inv(jacobian.T @ jacobian)
sizes = np.sqrt(np.diag(covariance))
correlation = covariance / np.outer(sizes, sizes)
h = 1e-6
columns = [
    (positions(TRUTH.at[i].add(h)) - positions(TRUTH.at[i].add(-h))) / (2 * h) for i in range(5)
]
jacobian_error = np.max(np.abs(np.stack(columns, axis=1) - jacobian)) / np.max(np.abs(jacobian))

# %% [markdown]
# ## How good must the first guess be?
#
# The first record once more, from random guesses.

# %%
draws = jax.random.uniform(jax.random.key(2), guesses.shape, minval=LOW, maxval=HIGH)
again = compiled(jnp.tile(records[0], (RECORDS, 1)), draws)
near = np.max(np.abs(np.asarray(again[0]) - estimates[0]) / errors[0], axis=1) < 0.1
total = time.perf_counter() - BEGUN
print(f"{near.mean():.0%} of random guesses end at the same estimate; {total:.0f} s in all")

relative = 100 * errors[found, :3].mean(axis=0) / truth[:3]
bias = float(np.max(np.abs(units.mean(axis=0))) * np.sqrt(found.sum()))
left = float(np.min(np.asarray(again[2])[~near], initial=np.inf)) / noise
worst = float(np.max(np.abs(covered.mean(axis=0) - 0.95)))
report = f"""# Identifying a stop from a noisy record of the motion

{unknowns}

Ideal drive, ζ = 0.9, {CYCLES} cycles with {impacts} impacts, {clean.size} positions with noise of \
{noise:.4f} a ({DECIBELS:g} dB below the signal's standard deviation); lengths in units of a, \
V0 in units of aω. {RECORDS} records, each fitted from the same first guess by Levenberg–Marquardt.

{int(found.sum())} of {RECORDS} fits ended at the noise, in {np.median(steps):.0f} steps in the \
median and {steps.max()} at most. The standard errors are honest: the share of estimates within \
1.96 of them differs from 95 % by at most {100 * worst:.1f} points, where chance alone makes \
±{100 * slack:.1f} with this many records. The largest bias of an unknown is {bias:.1f} standard \
errors of the mean of all estimates. The {impacts} impacts give k to {relative[0]:.1f} %, ξ to \
{relative[1]:.1f} % and d to {relative[2]:.2f} %. The errors of k and ξ go together \
(correlation {correlation[0, 1]:.2f}), since both take energy from the motion; the gap is nearly \
independent of them ({correlation[0, 2]:.2f}, {correlation[1, 2]:.2f}). The Jacobian through the \
impacts agrees with central differences to {jacobian_error:.0e} of its largest entry.

It is still a local method. From guesses drawn at random (k from {LOW[0]:g} to {HIGH[0]:g}, ξ from \
{LOW[1]:g} to {HIGH[1]:g}, d from {LOW[2]:g} to {HIGH[2]:g}, Y0 and V0 from {LOW[3]:g} to \
{HIGH[3]:g}) {near.mean():.0%} of the searches come to the estimate in the table. The others \
stop where at least {left:.1f} times the noise is left over, which gives them away.
"""
print(report)

# %%
figure = Figure(figsize=(11, 5.6), layout="constrained")
axes = figure.subplot_mosaic([["history"] * 5, list(NAMES)], height_ratios=[1.2, 1])
history = axes["history"]
place = 2 * np.arange(1, clean.size + 1) / SAMPLES
history.plot(place, records[0], ".", color="0.45", ms=3.5, label="record")
show = jax.jit(motion)
for unknowns, name, style in (
    (GUESS, "first guess", {"color": ORANGE, "lw": 1.0, "ls": "--"}),
    (jnp.asarray(estimates[0]), "fit", {"color": BLUE, "lw": 1.3}),
):
    vi.plot_history(
        show(unknowns), machine=scene_of(unknowns), ax=history, label=name, stops=False, **style
    )
history.axhline(truth[2], color=STOP, lw=1.5, label="stop", zorder=0)
history.set(xlim=(0, 2 * CYCLES), ylim=(-2.6, 2.1))
history.legend(loc="upper center", ncol=4, fontsize=9)
units = ("dimensionless", "dimensionless", "a", "a", "a ω")
for i, (name, unit) in enumerate(zip(NAMES, units, strict=True)):
    small = axes[name]
    small.hist(estimates[found, i], bins=14, color=paler(BLUE), density=True)
    spread = errors[found, i].mean()
    x = truth[i] + spread * np.linspace(-3.5, 3.5, 141)
    bell = np.exp(-0.5 * ((x - truth[i]) / spread) ** 2) / (spread * np.sqrt(2 * np.pi))
    small.plot(x, bell, color=BLUE, lw=1.3)
    small.axvline(truth[i], color=RED, lw=1.4, ls="--")
    height = 1.5 * bell.max()
    small.errorbar(estimates[0, i], height, xerr=errors[0, i], fmt="ko", ms=4, capsize=3)
    small.set(ylim=(0, 1.65 * bell.max()), yticks=[])
    small.xaxis.set_major_locator(MaxNLocator(3))
    small.tick_params(labelsize=8)
    small.set_xlabel(f"{name} ({unit})\n{covered[:, i].mean():.1%} covered")
axes[NAMES[2]].set_title(
    f"estimates from {RECORDS} records, truth (dashed), bell of the mean standard error; black: "
    "the record above, ± its standard error",
    fontsize=10,
)
numbers = {f"{name}, first record": float(estimates[0, i]) for i, name in enumerate(NAMES)}
numbers["k and ξ: correlation"] = float(correlation[0, 1])
numbers["noise"] = noise
write("identify", report, numbers, figure)
