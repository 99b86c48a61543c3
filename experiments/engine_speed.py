# %% [markdown]
# # Engine speed: one core, beside heyoka.py
#
# 1,024 lanes with Table 1's machine (T0 = 10 N·m, k = 0.5, κ = 0.5…1.9), 200 drive cycles, on one
# core: `FixedStep`, `Adaptive` and, for the ideal drive, `ExactFlight`, beside heyoka.py's batch
# mode (Taylor series, terminal events) in the same run. Rounds are interleaved; the table holds
# medians of five and the median final-state error. Compile time is apart.
#
# Run with `python experiments/engine_speed.py` (extra `bench`).

# %%
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

if hasattr(os, "sched_setaffinity"):  # before JAX counts its threads
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments")
QUICK = "--quick" in sys.argv
LANES, CYCLES, ROUNDS = (64, 20, 3) if QUICK else (1024, 200, 5)
BATCH = 256
KAPPA = np.linspace(0.5, 1.9, LANES)
TABLE = vi.Parameters(torque=10.0, restitution=0.5)
MOTOR = TABLE.scene(drive="motor")
XI, GAP, K = (
    float(x) for x in (MOTOR.damping_ratio, MOTOR.stops[0].gap, MOTOR.stops[0].restitution)
)

# %% [markdown]
# ## vi_jax: one compiled program for all lanes
#
# `jax.lax.map` with a batch size runs `vmap` over 256 lanes at a time. What such a batch carries
# stays in the processor's cache, and no batch waits for the slowest lane of another: a quarter to
# a third faster here than one `vmap` over all lanes.


# %%
def ours(method: vi.AbstractMethod, drive: str) -> tuple[Callable[[], np.ndarray], float]:
    """A timed call that gives the final (Y, V) of all lanes, and the time it took to compile."""

    def lane(kappa):
        scene = eqx.tree_at(lambda p: p.kappa, TABLE, kappa).scene(drive=drive)
        start = scene.start(W=kappa) if drive == "motor" else scene.start()
        run = vi.simulate(scene, start, CYCLES, method=method, record="sections")
        return jnp.stack([run.sections.Y[-1], run.sections.V[-1]])

    lanes = jnp.asarray(KAPPA)
    batched = vi.jit(lambda kappas: jax.lax.map(lane, kappas, batch_size=BATCH))
    begin = time.perf_counter()
    compiled = batched.lower(lanes).compile()
    seconds = time.perf_counter() - begin
    return lambda: np.asarray(jax.block_until_ready(compiled(lanes))), seconds


# %% [markdown]
# ## heyoka.py in its best configuration
#
# Batch 8 with the phase as independent variable. It was faster than batch 4, than scalar mode and
# than restarting its clock in each cycle; the cosine of the running phase is what costs it digits
# over a long run, so that the full-precision reference restarts it.


# %%
def heyoka_batch(
    drive: str, tol: float, *, wrapped: bool = False, batch: int = 8
) -> Callable[[], np.ndarray]:
    """A timed call that gives the final (Y, V) of all lanes by heyoka's batch integrator."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    Y, V, W = hy.make_vars("Y", "V", "W")
    phase, kappa = hy.time, hy.par[0]
    c, s = hy.cos(phase), hy.sin(phase)
    speed = W if drive == "motor" else kappa
    system = [(Y, V / speed), (V, (c - Y - 2 * XI * V) / speed)]
    if drive == "motor":
        motor = MOTOR.drive
        assert isinstance(motor, vi.Motor)
        tau0, eps, mu = (float(x) for x in (motor.strength, motor.coupling, motor.slider_inertia))
        torque = tau0 * (kappa - W) - eps * s * (Y - c) - mu * s * c * W * W
        system.append((W, torque / (W * (1 + mu * s * s))))
    size = len(system)

    def impact(integrator, direction, lane):
        integrator.state[1, lane] *= -K
        return True

    event = hy.t_event_batch(Y - GAP, direction=hy.event_direction.positive, callback=impact)
    integrator = hy.taylor_adaptive_batch(
        system, np.zeros((size, batch)), tol=tol, t_events=[event], pars=np.ones((1, batch))
    )

    def run() -> np.ndarray:
        final = np.zeros((LANES, 2))
        for i in range(0, LANES, batch):
            integrator.set_time(0.0)
            integrator.state[:2] = 0.0
            if drive == "motor":
                integrator.state[2] = KAPPA[i : i + batch]
            integrator.pars[0] = KAPPA[i : i + batch]
            if wrapped:
                for _ in range(CYCLES):
                    integrator.set_time(0.0)
                    integrator.propagate_until(2 * np.pi)
            else:
                integrator.propagate_until(2 * np.pi * CYCLES)
            final[i : i + batch] = integrator.state[:2].T
        return final

    return run


# %% [markdown]
# ## Interleaved rounds


# %%
def contest(
    drive: str, methods: dict[str, vi.AbstractMethod], tolerances: list[float]
) -> tuple[list, int]:
    """Rows (name, compile s, median s, median error) for one scene, and the lanes counted."""
    runs, compiling = {}, {}
    for name, method in methods.items():
        print(f"compiling {name} ({drive}) …", file=sys.stderr)
        runs[name], compiling[name] = ours(method, drive)
    for tol in tolerances:
        runs[f"heyoka {tol:.0e}"] = heyoka_batch(drive, tol)
    truth = heyoka_batch(drive, 1e-16, wrapped=True)()
    fine = vi.ExactFlight() if drive == "ideal" else vi.Adaptive(diffrax.Dopri8(), rtol=1e-14)
    second = ours(fine, drive)[0]()
    # Lanes in which two references differ are chaotic: there every method is at its own motion.
    regular = np.abs(truth - second).max(axis=1) < 1e-8
    print(f"{drive}: {regular.sum()} of {LANES} lanes are regular", file=sys.stderr)
    times: dict[str, list[float]] = {name: [] for name in runs}
    error = {}
    for name, run in runs.items():
        error[name] = float(np.median(np.abs(run() - truth).max(axis=1)[regular]))
    for _ in range(ROUNDS):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - begin)
    return [
        (name, compiling.get(name), statistics.median(times[name]), error[name]) for name in runs
    ], int(regular.sum())


def table(drive: str, rows: list, regular: int, base: str) -> str:
    """The rows as Markdown, with the speed relative to `base`."""
    reference = next(row[2] for row in rows if row[0] == base)
    lines = [
        f"### {drive.capitalize()} drive ({regular} of {LANES} lanes regular)",
        "",
        f"| method | compile, s | run, s | times as fast as {base} | median error |",
        "|---|---|---|---|---|",
    ]
    for name, compiling, seconds, error in rows:
        built = "–" if compiling is None else f"{compiling:.1f}"
        lines.append(
            f"| {name} | {built} | {seconds:.3f} | {reference / seconds:.2f} | {error:.1e} |"
        )
    return "\n".join(lines)


# %%
tsit, dopri = diffrax.Tsit5(), diffrax.Dopri8()
motor_rows, motor_regular = contest(
    "motor",
    {
        "FixedStep(Tsit5, 18)": vi.FixedStep(tsit, 18),
        "FixedStep(Tsit5, 32)": vi.FixedStep(tsit, 32),
        "FixedStep(Dopri8, 9)": vi.FixedStep(dopri, 9),
        "FixedStep(Dopri8, 12)": vi.FixedStep(dopri, 12),
        "FixedStep(Dopri8, 24)": vi.FixedStep(dopri, 24),
        "Adaptive(Tsit5, 1e-6)": vi.Adaptive(tsit, rtol=1e-6),
        "Adaptive(Dopri8, 1e-6)": vi.Adaptive(dopri, rtol=1e-6),
        "Adaptive(Dopri8, 1e-9)": vi.Adaptive(dopri, rtol=1e-9),
    },
    [1e-6, 1e-9, 1e-15],
)
ideal_rows, ideal_regular = contest(
    "ideal",
    {"ExactFlight": vi.ExactFlight(), "FixedStep(Tsit5, 18)": vi.FixedStep(tsit, 18)},
    [1e-6, 1e-12, 1e-15],
)
report = "\n\n".join(
    [
        f"{LANES:,} lanes, {CYCLES} cycles, one core; medians of {ROUNDS} interleaved rounds. "
        "The error is the median over the regular lanes of the final |(Y, V)| difference to a "
        "full-precision run.",
        table("motor", motor_rows, motor_regular, "heyoka 1e-06"),
        table("ideal", ideal_rows, ideal_regular, "heyoka 1e-12"),
    ]
)
print(report)

# %%
figure = Figure(figsize=(9, 4), layout="constrained")
FigureCanvasAgg(figure)
for axes, title, rows in zip(
    figure.subplots(1, 2, sharey=True),
    ("motor", "ideal drive"),
    (motor_rows, ideal_rows),
    strict=True,
):
    for name, _, seconds, error in rows:
        peer = name.startswith("heyoka")
        axes.loglog(error, seconds, "s" if peer else "o", color="tab:red" if peer else "tab:blue")
        axes.annotate(
            name,
            (error, seconds),
            xytext=(3, 4),
            textcoords="offset points",
            fontsize=6.5,
            rotation=28,
        )
    axes.set_title(f"{title}: {LANES:,} lanes, {CYCLES} cycles, one core")
    axes.set_xlabel("median error of the final state (units of a, aω)")
    axes.margins(x=0.35, y=0.2)
    axes.grid(alpha=0.3, which="both")
figure.axes[0].set_ylabel("run time, s")
if not QUICK:
    (HERE / "engine_speed.md").write_text("# Engine speed\n\n" + report + "\n")
    figure.savefig(HERE / "figures" / "engine_speed.png", dpi=110)
