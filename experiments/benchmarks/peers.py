# %% [markdown]
# # vi_jax beside its peers: same scenes, same cores, same error
#
# 1,024 lanes with Table 1's machine (T0 = 10 N·m, d = 2), 200 drive cycles, k = 0.5 and 0.8; κ of
# the motor, or ζ of the ideal drive, from 0.5 to 1.9. Each code runs in its best configuration
# found (see the files in `peer_codes/`), in processes pinned to their cores before anything is
# imported: one process for one core, one per core for all of them, the lanes dealt in blocks of
# neighbours. Where a code has a way of its own to use all cores, that is measured beside it.
# Rounds are interleaved; compile time is apart. The error is the median difference of the final
# (Y, V) to a full-precision run, over the lanes that do not amplify 1e-10 beyond 1e-6.
#
# Run with `python experiments/benchmarks/peers.py` (extra `bench`). What is measured is kept in the
# folder for temporary files, and an interrupted run goes on from there; `--fresh` forgets it.
# `--quick` takes few lanes and writes nothing. `--gpu` runs vi_jax on a GPU instead (no peers).

# %%
import hashlib
import json
import os
import platform
import statistics
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/benchmarks")
sys.path[:0] = [str(HERE), str(HERE.parent)]
from peer_codes.pool import Worker, cores, together
from peer_codes.task import PARAMETERS, Task

QUICK, GPU = "--quick" in sys.argv, "--gpu" in sys.argv
LANES, CYCLES, ROUNDS, SLOW_ROUNDS = (256, 20, 3, 1) if QUICK else (1024, 200, 5, 3)
KAPPA = np.linspace(0.5, 1.9, LANES)
RESTITUTIONS = (0.5, 0.8)
OURS = "vi_jax"
KEPT = Path(tempfile.gettempdir()) / f"vi_jax-peers-{'quick' if QUICK else 'full'}.json"


def note(text: str) -> None:
    """A line on how far the work is."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


# %% [markdown]
# ## Who runs
#
# `every` is the sample of lanes that a slow code is timed on: each so many-th block of neighbours.
# Its time is scaled up by that factor.


# %%
@dataclass(frozen=True)
class Entry:
    """A code with its options, and how its lanes are dealt."""

    name: str
    code: str
    options: dict[str, Any] = field(default_factory=dict)
    block: int = 16
    every: int = 1
    whole: bool = False
    """One process on all cores, with the code's own way of using them."""

    @property
    def rounds(self) -> int:
        """Fewer for the slow ones."""
        return ROUNDS if self.every == 1 else SLOW_ROUNDS


def ours(name: str, number: float = 0.0, *, whole: bool = False, **options: Any) -> Entry:
    """An entry of vi_jax."""
    inside = "" if not number else f"{number:g}"
    if name == "Taylor" and number > 1:
        inside += ", 8 steps"
    elif name == "FixedStep":
        inside = f"Verner9, {inside}"
    label = f"{OURS} {name}({inside})" + (", forced devices" if whole else "")
    return Entry(label, "ours", {"name": name, "number": number, **options}, whole=whole)


def heyoka(tol: float, **options: Any) -> Entry:
    """An entry of heyoka in batch mode."""
    return Entry(f"heyoka batch 8, {tol:.0e}", "heyoka_taylor", {"tol": tol, **options})


def entries(drive: str, all_cores: bool) -> list[Entry]:
    """All codes for one scene."""
    sparse = LANES // 8 if not all_cores else LANES // (8 if len(cores()) > 8 else 16)
    motor = [("FixedStep", n) for n in (5, 6, 8, 10, 12, 16, 20, 24)]
    motor += [("Taylor", n) for n in (14, 16, 18)] + [("Taylor", 1e-12), ("Taylor", 1e-13)]
    methods = motor if drive == "motor" else [("ExactFlight", 0), ("FixedStep", 10)]
    listed = [ours(*method) for method in methods]
    listed += [heyoka(tol) for tol in (1e-6, 1e-9, 1e-15)]
    scalar = {"tol": 1e-9, "batch": 1}
    listed += [Entry("heyoka scalar, 1e-09", "heyoka_taylor", scalar, every=4)]
    listed += [
        Entry(f"numba Dormand–Prince, {tol:.0e}", "numba_rk", {"tol": tol}, every=4)
        for tol in (1e-6, 1e-9)
    ]
    listed += [
        Entry(
            f"diffrax Event {solver}, {tol:.0e}",
            "diffrax_event",
            {"solver": solver, "tol": tol},
            block=64,
            every=4,
        )
        for solver, tol in (("Tsit5", 1e-6), ("Dopri8", 1e-9))
    ]
    listed += [Entry("SciPy DOP853, 1e-09", "scipy_ivp", {"tol": 1e-9}, block=1, every=sparse)]
    if all_cores:
        best = ("FixedStep", 10) if drive == "motor" else methods[0]
        threads = {"tol": 1e-9, "threads": len(cores())}
        prange = {"tol": 1e-9, "parallel": True}
        listed += [
            ours(*best, whole=True),
            Entry("heyoka ensemble, threads, 1e-09", "heyoka_taylor", threads, whole=True),
            Entry("numba Dormand–Prince, prange, 1e-09", "numba_rk", prange, whole=True),
        ]
    return listed


def derivative_entries() -> list[Entry]:
    """The codes that give derivatives by six parameters, each primal beside its derivatives."""
    listed = []
    for method in (("FixedStep", 6), ("FixedStep", 10), ("FixedStep", 16), ("Taylor", 1e-12)):
        primal = ours(*method)
        with_six = Entry(primal.name + " six jvp", "ours", {**primal.options, "jacobian": True})
        listed += [primal, with_six]
    for tol in (1e-6, 1e-9, 1e-15):
        options = {"tol": tol, "jacobian": True}
        named = f"heyoka variational, saltation by hand, {tol:.0e}"
        listed += [heyoka(tol), Entry(named, "heyoka_taylor", options)]
    return listed


# %% [markdown]
# ## The measurement


# %%
@dataclass
class Job:
    """An entry, set up on the workers that it runs on."""

    entry: Entry
    workers: list[Worker]
    shares: list[np.ndarray]
    compiling: float = 0.0

    @property
    def lanes(self) -> np.ndarray:
        """Indices of the lanes that it runs."""
        return np.concatenate(self.shares)

    def all(self, *message: Any) -> tuple[list, float]:
        """The same message to all of its workers."""
        return together(self.workers, [message] * len(self.workers))

    def begin_build(self, task: Task) -> None:
        """Send what is to be set up and compiled, without waiting for it."""
        for worker, share in zip(self.workers, self.shares, strict=True):
            name, code, options = self.entry.name, self.entry.code, self.entry.options
            worker.ask("build", name, code, task, KAPPA[share], options)

    def end_build(self) -> None:
        """Wait for it; the largest of the workers' compile times is kept."""
        self.compiling = max(worker.answer() for worker in self.workers)
        note(f"  built {self.entry.name}")

    def result(self) -> np.ndarray:
        """What it gives for its lanes, in the order of `lanes`."""
        return np.concatenate(self.all("result", self.entry.name)[0])

    def timed(self) -> float:
        """Seconds for all lanes of the scene."""
        return self.all("run", self.entry.name)[1] * LANES / len(self.lanes)


class Bench:
    """The workers, started when they are first needed."""

    def __init__(self):
        self.cores = cores()
        self._pinned: list[Worker] = []
        self._whole: Worker | None = None

    @property
    def pinned(self) -> list[Worker]:
        """A worker on each core."""
        if not self._pinned:
            self._pinned = [Worker([core]) for core in self.cores]
        return self._pinned

    @property
    def whole(self) -> Worker:
        """A worker on all cores."""
        if self._whole is None:
            self._whole = Worker(self.cores, devices=len(self.cores))
        return self._whole

    def jobs(self, listed: list[Entry], task: Task, *, all_cores: bool) -> list[Job]:
        """Entries, compiled. For one core each sits on some core, so that they compile together."""
        jobs = []
        for i, entry in enumerate(listed):
            shares = task.dealt(
                LANES, entry.block, entry.every, len(self.cores) if all_cores else 1
            )
            workers = self.pinned if all_cores else [self.pinned[i % len(self.cores)]]
            if entry.whole:
                workers, shares = [self.whole], [np.concatenate(shares)]
            jobs.append(Job(entry, workers, shares))
            jobs[-1].begin_build(task)
        for job in jobs:
            job.end_build()
        return jobs

    def close(self) -> None:
        """End all workers."""
        for worker in [*self._pinned, *([self._whole] if self._whole else [])]:
            worker.close()


def reference(bench: Bench, task: Task, *, jacobian: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The full-precision results, and which lanes are regular."""
    found = []
    for name, shifted in (("reference", 0.0), ("shifted", 1e-10)):
        start = Task(task.drive, task.k, task.cycles, Y0=shifted)
        wanted = jacobian and not shifted
        options = {"tol": 1e-16, "wrapped": not wanted, "jacobian": wanted}
        entry = Entry(name, "heyoka_taylor", options)
        (job,) = bench.jobs([entry], start, all_cores=True)
        lanes = np.empty((LANES, 2, len(PARAMETERS)) if wanted else (LANES, 2))
        lanes[job.lanes] = job.result()
        found.append(lanes)
    if jacobian:
        return found[0], reference(bench, task)[1]
    return found[0], np.abs(found[0] - found[1]).max(axis=1) < 1e-6


def measure(bench: Bench, task: Task, listed: list[Entry], truth, *, all_cores: bool) -> list[dict]:
    """A row for each entry, from interleaved rounds."""
    exact, regular = truth
    jobs = bench.jobs(listed, task, all_cores=all_cores)
    rows: list[dict[str, Any]] = []
    for job in jobs:
        found, right = job.result(), exact[job.lanes]
        if found.ndim < right.ndim:  # the primal among derivatives, whose error is told elsewhere
            error = np.full(len(found), np.nan)
        elif found.ndim == 3:
            error = np.abs(found - right).max(axis=(1, 2)) / np.abs(right).max(axis=(1, 2))
        else:
            error = np.abs(found - right).max(axis=1)
        error = error[regular[job.lanes]]
        rows.append(
            {
                "name": job.entry.name,
                "compiling": job.compiling,
                "error": float(np.median(error)),
                "lost": float(np.mean(error > 1e-3)),
                "lanes": len(job.lanes),
                "rounds": job.entry.rounds,
                "times": [],
            }
        )
    for i in range(ROUNDS):
        for job, row in zip(jobs, rows, strict=True):
            if i < job.entry.rounds:
                row["times"].append(job.timed())
    for row in rows:
        row["seconds"] = statistics.median(row["times"])
        note(f"  {row['name']:48s} {row['seconds']:9.3f} s  error {row['error']:.1e}")
    for worker in {id(worker): worker for job in jobs for worker in job.workers}.values():
        together([worker], [("drop", "")])
    return rows


def sources() -> str:
    """Fingerprint of all that decides the figures: what was measured with other code is stale."""
    files = [*HERE.glob("peers.py"), *HERE.glob("peer_codes/*.py")]
    files += [
        file
        for room in ("flow", "lanes", "scene")
        for file in (HERE.parents[1] / "vi_jax" / room).iterdir()
    ]
    return hashlib.sha256(
        b"".join(file.read_bytes() for file in sorted(files) if file.is_file())
    ).hexdigest()


def contest() -> dict[str, dict]:
    """All sections, taken from where an earlier run left off."""
    stamp = sources()
    kept: dict[str, Any] = {}
    if KEPT.exists() and "--fresh" not in sys.argv:
        kept = json.loads(KEPT.read_text())
        if kept.get("stamp") != stamp:
            kept = {}
    kept["stamp"] = stamp
    bench = Bench()
    try:
        wanted = [(drive, k, False) for drive in ("motor", "ideal") for k in RESTITUTIONS]
        for drive, k, jacobian in [*wanted, ("motor", 0.5, True)]:
            task, truth = Task(drive, k, CYCLES), None
            for all_cores in (False, True):
                kind = "derivatives" if jacobian else "states"
                key = f"{kind}, {drive}, {k}, {'all' if all_cores else 'one'}"
                if key in kept:
                    continue
                note(key)
                truth = truth or reference(bench, task, jacobian=jacobian)
                listed = derivative_entries() if jacobian else entries(drive, all_cores)
                rows = measure(bench, task, listed, truth, all_cores=all_cores)
                kept[key] = {"rows": rows, "regular": int(truth[1].sum())}
                KEPT.write_text(json.dumps(kept))
    finally:
        bench.close()
    return {key: value for key, value in kept.items() if key != "stamp"}


# %% [markdown]
# ## Ratios at the same error
#
# vi_jax's time at a peer's error is read off the straight lines between its own points, both axes
# logarithmic: the fastest of its points or lines that is at least as accurate. A peer that is more
# accurate than the most accurate point of vi_jax is compared with that point, and marked with <.


# %%
def at_error(rows: list[dict], error: float) -> tuple[float, bool]:
    """Seconds of vi_jax at an error, and whether it reaches it."""
    points = sorted((row["error"], row["seconds"]) for row in rows)
    if error < points[0][0]:
        return points[0][1], False
    best = min(seconds for own, seconds in points if own <= error)
    for (fine, slow), (coarse, fast) in (
        (a, b) for a in points for b in points if a[0] < error < b[0]
    ):
        share = np.log(error / fine) / np.log(coarse / fine)
        best = min(best, float(np.exp((1 - share) * np.log(slow) + share * np.log(fast))))
    return best, True


def table(rows: list[dict], compared: list[dict]) -> list[str]:
    """Markdown; `compared` are the rows of vi_jax that peers are set against."""
    lines = [
        "| method | compile, s | run, s | median error | lost | time / vi_jax's, same error |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        sampled = "" if row["lanes"] == LANES else f" ({row['lanes']} lanes, scaled up)"
        ratio = ""
        if not row["name"].startswith(OURS) and np.isfinite(row["error"]):
            seconds, reached = at_error(compared, row["error"])
            ratio = f"{row['seconds'] / seconds:.2f}" + ("" if reached else " <")
        error = f"{row['error']:.1e} | {100 * row['lost']:.1f} %"
        if not np.isfinite(row["error"]):
            error = "– | –"
        lines.append(
            f"| {row['name']}{sampled} | {row['compiling']:.1f} | {row['seconds']:.3f} | "
            f"{error} | {ratio} |"
        )
    return lines


def report(sections: dict[str, dict]) -> str:
    """All tables."""
    lines = [
        f"{LANES:,} lanes, {CYCLES} cycles; {len(cores())} cores ({platform.processor() or 'CPU'}, "
        f"{platform.machine()}); medians of {ROUNDS} interleaved rounds, of {SLOW_ROUNDS} for the "
        "codes that run a sample of the lanes. The error is the median over the regular lanes, "
        "those that do not amplify 1e-10 beyond 1e-6; lost is the share of them whose final state "
        "is off by more than 1e-3. The last column is a peer's time over vi_jax's at the same "
        "error, above 1 where vi_jax is faster; < where the peer is more accurate than all "
        "points of vi_jax. All cores: one process a core, if not said otherwise.",
    ]
    for key, section in sections.items():
        kind, drive, k, used = key.split(", ")
        rows = section["rows"]
        title = f"{drive.capitalize()} drive, k = {k}, {used} core{'s' * (used == 'all')}"
        if kind == "derivatives":
            by = ", ".join(PARAMETERS)
            title += f": final (Y, V) by {by}"
        lines += ["", f"## {title} ({section['regular']} of {LANES} lanes regular)", ""]
        own = [row for row in rows if row["name"].startswith(OURS) and np.isfinite(row["error"])]
        lines += table(rows, own)
        if kind == "derivatives":
            lines += ["", "| derivatives over primal | ratio |", "|---|---|"]
            for primal, with_six in zip(rows[::2], rows[1::2], strict=True):
                ratio = with_six["seconds"] / primal["seconds"]
                lines.append(f"| {with_six['name']} | {ratio:.2f} |")
    return "\n".join(lines)


def picture(sections: dict[str, dict]) -> Any:
    """Time against error at the first restitution, a panel for each drive and number of cores."""
    from matplotlib.figure import Figure
    from vi_jax.plot.colors import BLUE, GREEN, PERIODS, RED

    looks = {
        f"{OURS} FixedStep": (BLUE, "s"),
        f"{OURS} Taylor": (BLUE, "o"),
        f"{OURS} ExactFlight": (BLUE, "*"),
        "heyoka batch": (RED, "s"),
        "heyoka scalar": (RED, "o"),
        "heyoka ensemble": (RED, "^"),
        "numba": (GREEN, "s"),
        "diffrax Event Tsit5": (PERIODS[2], "s"),
        "diffrax Event Dopri8": (PERIODS[2], "o"),
        "SciPy": ("0.5", "s"),
    }
    figure = Figure(figsize=(9, 7), layout="constrained")
    panels = figure.subplots(2, 2, sharex="row", sharey="row")
    handles: dict[str, Any] = {}
    for axes, (drive, used) in zip(
        panels.flat, ((d, u) for d in ("motor", "ideal") for u in ("one", "all")), strict=True
    ):
        rows = sections[f"states, {drive}, {RESTITUTIONS[0]}, {used}"]["rows"]
        for family, (color, mark) in looks.items():
            mine = [
                row
                for row in rows
                if row["name"].startswith(family) and "forced" not in row["name"]
            ]
            points = sorted((row["error"], row["seconds"]) for row in mine)
            if points:
                size = 11 if mark == "*" else 5
                look = {"color": color, "marker": mark, "ms": size, "lw": 1, "label": family}
                (handles[family],) = axes.loglog(*zip(*points, strict=True), **look)
        axes.set_title(f"{drive} drive, {used} core{'s' * (used == 'all')}", fontsize=10)
        axes.grid(alpha=0.3)
    for axes in panels[:, 0]:
        axes.set_ylabel("1,024 lanes, 200 cycles: run time (s)")
    for axes in panels[1]:
        axes.set_xlabel("median error of the final state (a, a ω)")
    figure.legend(handles=handles.values(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def headline(sections: dict[str, dict]) -> dict[str, float]:
    """What a test can compute again: an error of vi_jax's own."""
    wanted = f"{OURS} FixedStep(Verner9, 10)"
    rows = sections[f"states, ideal, {RESTITUTIONS[-1]}, one"]["rows"]
    error = next((row["error"] for row in rows if row["name"] == wanted), None)
    name = f"{wanted}, ideal drive, k = {RESTITUTIONS[-1]:g}: median error"
    return {} if error is None else {name: error}


# %% [markdown]
# ## On a GPU
#
# Lanes in batches that fit the memory, 200 cycles, double and single precision. The arithmetic is
# counted by the compiler for one step of one lane; a sine, a root or a comparison counts as one.


# %%
def on_gpu() -> str:
    """A table of vi_jax on JAX's default device."""
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import vi_jax as vi

    jax.config.update("jax_enable_x64", True)
    device = jax.devices()[0]
    if device.platform == "cpu" and not QUICK:
        raise SystemExit("JAX's default device is no GPU; nothing was measured.")
    sizes = (1_000, 4_000) if QUICK else (100_000, 1_000_000, 10_000_000)
    batch = 1_000 if QUICK else 500_000
    scenes = [
        ("motor", "FixedStep(Verner9, 10)", vi.FixedStep()),
        ("motor", "Adaptive(Verner9, 1e-6)", vi.Adaptive(rtol=1e-6)),
        ("ideal", "ExactFlight()", vi.ExactFlight()),
    ]
    lines = [
        f"{device.device_kind}, {CYCLES} cycles, k = 0.5, batches of up to {batch:,} lanes; the "
        "faster of two runs.",
        "",
        "| drive | method | precision | lanes | compile, s | run, s | 10⁶ lane-cycles/s | "
        "steps a cycle | 10⁹ operations/s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for drive, name, method in scenes:
        for dtype in ("float64", "float32"):
            machine = Task(drive, 0.5, CYCLES)

            def scene_of(kappa, machine=machine):
                numbers = (
                    machine.tau0,
                    machine.eps,
                    machine.mu,
                    machine.xi,
                    machine.gap,
                    machine.k,
                )
                tau0, eps, mu, xi, gap, k = (jnp.asarray(x, kappa.dtype) for x in numbers)
                one = jnp.ones_like(kappa)
                turning = vi.Motor(tau0, kappa, eps, mu, one)
                drive = turning if machine.motor else vi.IdealDrive(kappa)
                stops = (vi.RigidStop(gap, k),)
                return vi.Scene(oscillator=vi.Oscillator(xi), drive=drive, stops=stops)

            def start_of(scene, kappa, machine=machine):
                start = scene.start(W=kappa) if machine.motor else scene.start()
                return jax.tree.map(lambda x: jnp.asarray(x, kappa.dtype), start)

            def lane(kappa, method=method):
                scene = scene_of(kappa)
                start = start_of(scene, kappa)
                run = vi.simulate(scene, start, CYCLES, method=method, record="sections")
                return run.sections.Y[-1], run.steps, run.result

            def one_step(kappa, method=method):
                scene = scene_of(kappa)
                one = jnp.ones_like(kappa)
                start = start_of(scene, kappa)
                return method.step(scene, 0 * one, 0.5 * one, start, None)[0]

            stepped = jax.jit(one_step).lower(jnp.asarray(0.9, dtype)).compile().cost_analysis()
            operations = float(stepped["flops"]) if stepped else float("nan")
            for lanes in sizes:
                kappas = jnp.linspace(0.5, 1.9, lanes, dtype=dtype)
                begin = time.perf_counter()
                mapped = jax.jit(
                    lambda xs, lane=lane: jax.lax.map(lane, xs, batch_size=min(batch, xs.size))
                )
                compiled = mapped.lower(kappas).compile()
                compiling = time.perf_counter() - begin
                times: list[float] = []
                found: Any = None
                for _ in range(2):
                    begin = time.perf_counter()
                    found = jax.block_until_ready(compiled(kappas))
                    times.append(time.perf_counter() - begin)
                assert found[0].dtype == dtype
                steps = float(jnp.mean(found[1]))
                seconds = min(times)
                lines.append(
                    f"| {drive} | {name} | {dtype} | {lanes:,} | {compiling:.1f} | {seconds:.3f} | "
                    f"{lanes * CYCLES / seconds / 1e6:.1f} | {steps / CYCLES:.1f} | "
                    f"{operations * steps * lanes / seconds / 1e9:.0f} |"
                )
                note(lines[-1])
            eqx.clear_caches()
    return "\n".join(lines)


# %%
if __name__ == "__main__":
    os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.9")
    measured: dict[str, dict] = {}
    if GPU:
        written, text = "peers_gpu.md", "# vi_jax on a GPU\n\n" + on_gpu()
    else:
        measured = contest()
        written, text = "peers.md", "# vi_jax beside its peers\n\n" + report(measured)
    print(text)
    if GPU and not QUICK:
        (HERE / written).write_text(text + "\n")
    if not GPU:
        from headlines import keep

        figure, numbers = picture(measured), headline(measured)
        if not QUICK:
            keep(HERE, "peers", text, numbers, figure)
