"""vi_jax on a GPU: lanes in batches that fit the memory, in double and in single precision."""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi
from tools.tables import table
from vi_jax.flow.smooth import in_modes

from .contest import note
from .entries import CYCLES, QUICK
from .task import Task

jax.config.update("jax_enable_x64", True)
_SIZES = (1_000, 4_000) if QUICK else (100_000, 1_000_000, 10_000_000)
_BATCH = 1_000 if QUICK else 500_000
_METHODS = [
    ("motor", "FixedStep(Verner9, 10)", vi.FixedStep()),
    ("motor", "Adaptive(Verner9, 1e-6)", vi.Adaptive(rtol=1e-6)),
    ("ideal", "ExactFlight()", vi.ExactFlight()),
]


def on_gpu() -> str:
    """A table of vi_jax on JAX's default device.

    The arithmetic is counted by the compiler for one step of one lane; a sine, a root or a
    comparison counts as one.
    """
    device = jax.devices()[0]
    if device.platform == "cpu" and not QUICK:
        raise SystemExit("JAX's default device is no GPU; nothing was measured.")
    heads = [
        "drive", "method", "precision", "lanes", "compile, s", "run, s", "10⁶ lane-cycles/s",
        "steps a cycle", "10⁹ operations/s",
    ]  # fmt: skip
    rows = []
    for drive, name, method in _METHODS:
        for dtype in ("float64", "float32"):
            with jax.enable_x64(dtype == "float64"):
                rows += [[drive, name, dtype, *cells] for cells in _measured(drive, method, dtype)]
            eqx.clear_caches()
    return (
        f"{device.device_kind}, {CYCLES} cycles, k = 0.5, batches of up to {_BATCH:,} lanes; the "
        f"faster of two runs.\n\n{table(heads, rows)}"
    )


def _machine(task: Task, kappa: jax.Array) -> tuple[vi.Scene, Any]:
    """The machine and its start, in the precision of κ."""
    numbers = (task.tau0, task.eps, task.mu, task.xi, task.gap, task.k)
    tau0, eps, mu, xi, gap, k = (jnp.asarray(x, kappa.dtype) for x in numbers)
    motor = vi.Motor(tau0, kappa, eps, mu, jnp.ones_like(kappa))
    drive = motor if task.motor else vi.IdealDrive(kappa)
    stops = (vi.RigidStop(gap, k),)
    machine = vi.Scene(oscillator=vi.Oscillator(xi), drive=drive, stops=stops)
    start = machine.start(W=kappa) if task.motor else machine.start()
    return machine, jax.tree.map(lambda x: jnp.asarray(x, kappa.dtype), start)


def _measured(drive: str, method: Any, dtype: str) -> list[list[str]]:
    """The numbers of one method in one precision, for each number of lanes."""
    task = Task(drive, 0.5, CYCLES)

    def lane(kappa):
        machine, start = _machine(task, kappa)
        run = vi.simulate(machine, start, CYCLES, method=method, record="sections")
        return run.sections.Y[-1], run.steps, run.result

    def one_step(kappa):
        machine, start = _machine(task, kappa)
        one = jnp.ones_like(kappa)
        return method.step(in_modes(machine, ()), 0 * one, 0.5 * one, start, None)[0]

    stepped = jax.jit(one_step).lower(jnp.asarray(0.9, dtype)).compile().cost_analysis()
    operations = float(stepped["flops"]) if stepped else float("nan")
    rows = []
    for lanes in _SIZES:
        kappas = jnp.linspace(0.5, 1.9, lanes, dtype=dtype)
        begin = time.perf_counter()
        mapped = jax.jit(lambda xs: jax.lax.map(lane, xs, batch_size=min(_BATCH, xs.size)))
        compiled = mapped.lower(kappas).compile()
        compiling = time.perf_counter() - begin
        times: list[float] = []
        found: Any = None
        for _ in range(2):
            begin = time.perf_counter()
            found = jax.block_until_ready(compiled(kappas))
            times.append(time.perf_counter() - begin)
        assert found[0].dtype == dtype
        steps, seconds = float(jnp.mean(found[1])), min(times)
        rows.append([
            f"{lanes:,}", f"{compiling:.1f}", f"{seconds:.3f}",
            f"{lanes * CYCLES / seconds / 1e6:.1f}", f"{steps / CYCLES:.1f}",
            f"{operations * steps * lanes / seconds / 1e9:.0f}",
        ])  # fmt: skip
        note(f"{drive} {method} {dtype} {rows[-1]}")
    return rows
