# %% [markdown]
# # vi_jax on a GPU
#
# Table 1's machine (T0 = 10 N·m, d = 2, k = 0.5) runs for 200 drive cycles, with κ or ζ from 0.5 to
# 1.9. Precision is double or single, and batches have 100,000 lanes. XLA counts the arithmetic of
# one step of one lane; a sine, a root or a comparison is one operation.
#
# `python experiments/benchmarks/gpu.py` measures JAX's default device and prints a table, with
# `--batch 500000` in larger batches. With `JAX_PLATFORMS=cpu` it measures the processor instead.
# `--check` compares the numbers of every verb on that device with those of the processor.

# %%
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.9")
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from peer_codes.contest import note
from peer_codes.entries import CYCLES, QUICK
from peer_codes.task import Task
from tools.tables import table
from vi_jax.flow.smooth import in_modes

jax.config.update("jax_enable_x64", True)
_SIZES = (1_000, 4_000) if QUICK else (10_000, 100_000, 1_000_000)
_BATCH = int(sys.argv[sys.argv.index("--batch") + 1]) if "--batch" in sys.argv else 100_000
_METHODS = [
    ("motor", "FixedStep(Verner9, 10)", vi.FixedStep()),
    ("motor", "Adaptive(Verner9, 1e-6)", vi.Adaptive(rtol=1e-6)),
    ("ideal", "ExactFlight()", vi.ExactFlight()),
]


def measured() -> str:
    """Return a table of vi_jax's speed on JAX's default device."""
    device = jax.devices()[0]
    heads = [
        "drive", "method", "precision", "lanes", "compile, s", "run, s", "10⁶ lane-cycles/s",
        "steps a cycle", "10⁹ operations/s",
    ]  # fmt: skip
    rows = []
    for drive, name, method in _METHODS:
        for dtype in ("float64", "float32"):
            with jax.enable_x64(dtype == "float64"):
                rows += [[drive, name, dtype, *cells] for cells in _rows(drive, method, dtype)]
            eqx.clear_caches()
    return (
        f"JAX {jax.__version__}, {device.device_kind}, {CYCLES} cycles, k = 0.5, batches of up to "
        f"{_BATCH:,} lanes; the faster of two runs.\n\n{table(heads, rows)}"
    )


def _machine(task: Task, kappa: jax.Array) -> tuple[vi.Scene, Any]:
    """Return the machine and its start, in the precision of κ."""
    numbers = (task.tau0, task.eps, task.mu, task.xi, task.gap, task.k)
    tau0, eps, mu, xi, gap, k = (jnp.asarray(x, kappa.dtype) for x in numbers)
    motor = vi.Motor(tau0, kappa, eps, mu, jnp.ones_like(kappa))
    drive = motor if task.motor else vi.IdealDrive(kappa)
    stops = (vi.RigidStop(gap, k),)
    machine = vi.Scene(damping_ratio=xi, drive=drive, stops=stops)
    start = machine.start(W=kappa) if task.motor else machine.start()
    return machine, jax.tree.map(lambda x: jnp.asarray(x, kappa.dtype), start)


def _rows(drive: str, method: Any, dtype: str) -> list[list[str]]:
    """Return the table's rows of one method in one precision, for each number of lanes."""
    task = Task(drive, 0.5, CYCLES)

    def lane(kappa):
        machine, start = _machine(task, kappa)
        run = vi.simulate(machine, start, CYCLES, method=method, record="sections")
        return run.sections.Y[-1], run.steps, run.result

    def one_step(kappa):
        machine, start = _machine(task, kappa)
        one = jnp.ones_like(kappa)
        return method.step(in_modes(machine, ()), 0 * one, 0.5 * one, start, {})[0]

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


# %%
class _Blocks(vi.Mechanical):
    """A block on a shaken floor with friction; a second block with dry friction strikes it."""

    q = ("x", "y", "z")
    mass = (1.0, 1.0, 0.5)
    cycle = 2 * np.pi
    contacts = (
        vi.RigidStop(0.0, 0.4, "left", on="y", friction=0.3, along="x"),
        vi.RigidStop(0.5, 0.8, on=lambda q: q.z - q.x),
        vi.DryFriction(0.1, on="z"),
    )

    def force(self, t, q, v):
        pull = 0.4 * jnp.sin(t) - q.x
        return dict(x=pull, y=-1 + 1.5 * jnp.cos(t), z=0.5 * jnp.cos(t) - q.z)


def _verbs() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the name and the call of each verb."""
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.05)
    ready: dict[str, Any] = {"Scene": scene, "Scene with motor": vi.Parameters().scene()}
    kinds = ("ImpactPair", "Capsule", "ReliefValve", "Duffing", "BouncingBall")
    ready |= {kind: getattr(vi.machines, kind)() for kind in kinds}
    ready["Mechanical, two blocks with friction"] = _Blocks()
    for name, machine in ready.items():
        many = jax.tree.map(lambda x: x + jnp.linspace(0, 0.01, 64), machine.start())
        run = jax.vmap(lambda start, machine=machine: vi.simulate(machine, start, 5).last)
        yield f"`simulate`, {name}", lambda run=run, many=many: run(many)

    def last(k):
        machine = vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=2.0)
        return vi.simulate(machine, machine.start(), 20).last.Y

    def orbit():
        settled = vi.simulate(scene, scene.start(), 1, settle=60).last
        return vi.find_orbit(scene, settled, cycles=2)

    def branch():
        found = vi.continue_orbit(orbit(), parameter="drive.frequency_ratio", bounds=(0.85, 0.95))
        return found.to_xarray().y_min.values

    axis, square = "drive.frequency_ratio", {"start.Y": (-1.0, 1.0), "start.V": (-1.0, 1.0)}
    yield "`jax.jvp`", lambda: jax.jvp(last, (0.5,), (1.0,))
    yield "`jax.grad`", lambda: jax.grad(last)(0.5)
    yield "`find_orbit`", lambda: (orbit().state, jnp.abs(orbit().multipliers))
    yield "`continue_orbit`", branch
    yield "`lyapunov`", lambda: vi.lyapunov(scene, scene.start(), cycles=200).exponents
    yield "`sweep`", lambda: vi.sweep(scene, axis, np.linspace(0.8, 0.9, 6), cycles=8).y_min
    scanned = {axis: np.linspace(0.7, 1.1, 32)}
    yield "`scan`", lambda: [x.values for x in vi.scan(scene, scanned, cycles=128).values()]
    basins = lambda: vi.basins(scene, square, resolution=8, settle=60).data
    yield "`basins`", lambda: [x.values for x in basins().values()]


def checked() -> str:
    """Return a table of the differences between JAX's default device and the processor."""
    rows = []
    for name, call in _verbs():
        ours = jax.tree.leaves(call())
        with jax.default_device(jax.devices("cpu")[0]):
            theirs = jax.tree.leaves(call())
        pairs = zip(ours, theirs, strict=True)
        apart = [np.abs(np.asarray(a, float) - b) / (1 + np.abs(b)) for a, b in pairs]
        worst = max((float(np.nanmax(x)) for x in apart if np.size(x)), default=float("nan"))
        rows.append([name, f"{worst:.0e}"])
        note(f"{rows[-1]}")
    return table(["", "largest difference, relative to 1 + size"], rows)


# %%
if __name__ == "__main__":
    print(checked() if "--check" in sys.argv else measured())
