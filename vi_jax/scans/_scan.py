"""`scan`: axes over parameters and starts give a labelled data set."""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .._checks import count, flag, instance_of
from .._messages import at_work, warning_once
from .._types import State, xr
from ..flow import REASON_NAMES, AbstractMethod, MethodLike, RunOptions, preset
from ..machine import AbstractMachine
from ._computed import ScanInterrupted, Workplace, computed, in_blocks, workplace
from ._lane_noise import lane_numbers
from .grid import Blocks, axes_of
from .program import ScanProgram, make_program


class LanesFailed(UserWarning):
    """Said of a scan of which some lanes failed."""


@warning_once
def scan(
    machine: AbstractMachine | Callable[..., AbstractMachine],
    axes: Mapping[str, Any],
    *,
    measure: Any = ("extremes", "regime"),
    start: State = None,
    settle: int = 200,
    cycles: int | None = None,
    method: MethodLike = None,
    clock: str | None = None,
    derivatives: str | Iterable[str] = (),
    noise: Any = None,
    key: Any = None,
    paired: bool = False,
    verify: int = 0,
    max_impacts: int = 1000,
    max_steps: int | None = None,
    store: str | Path | None = None,
    lanes: int | None = None,
    workers: int | None = None,
    devices: int | None = None,
    cluster: Any = None,
    progress: bool = True,
) -> "xr.Dataset":
    """Simulate every combination of the axes' values and keep measures of each motion.

    Other values on the axes, in the machine or in `settle` compile nothing again.

    **Arguments:**

    - `machine`: the machine, or a function that makes it from the axes' values by name (define it
      once, since another function compiles again).
    - `axes`: names of numbers of the machine (`"drive.frequency_ratio"`, `"stops.0.restitution"`)
      or of the start (`"start.Y"`), each with a row of values.
    - `measure`: what is kept: names out of `"extremes"`, `"regime"`, `"frequency_ratio"`,
      `"power"`, `"impact_rate"`, `"sections"`, `"exponent"`, `"steps"`, or of the machine's own
      `averages`, which replace ours of the same name; `AbstractMeasure`s; functions of a lane's
      machine and `Run` that return named numbers.
    - `start`: the first state; by default the machine's own start at rest.
    - `settle`, `cycles`: drive cycles before observing, and observed (static; by default 32 or
      what the measures need); `method`, `clock`, `max_impacts`, `max_steps`: as for `simulate`.
    - `derivatives`: names, as on the axes, with respect to which every real variable is
      differentiated: `d_y_min` and so on, with an axis `by`.
    - `noise`, `key`: a `WhiteNoise`, by default none, and with it one key of JAX's. Lane n of the
      grid (the last axis is filled first) has the key `jax.random.fold_in(key, n)`. `"noise.V"` is
      an axis of amplitudes, `"noise.path"` of paths. Measures that look for a period are refused.
    - `paired`: a lane for each place in the rows (of one length), along `sample`, and no grid.
    - `verify`: the number of lanes, drawn at random, that are run again by a tighter method.
      `data.attrs` then holds the number of different lanes (`verified_changed_period`, for
      integers) or the error that 95 of 100 stay below (`verified_error_y_min`; infinite if one
      failed).
    - `store`: folder of a Zarr store, written block by block. The same call resumes it and computes
      again what was lost; a changed one (or your functions' code) is refused with the difference.
    - `lanes`: lanes in a block (a multiple of 256); memory grows with it and with `cycles`.
    - `workers`, `devices`: blocks at work at once on a CPU (by default one a core), and local
      devices over which a block is spread (all by default).
    - `cluster`: a `dask.distributed.Client`, or an `Executor` of `concurrent.futures`, to compute
      the blocks there.
    - `progress`: show a bar, in a terminal or a notebook.

    **Returns:** an `xarray.Dataset` over the axes, with units; `result` is the reason why each lane
    ended (0: completed; -1: not computed). With a `store` it is read lazily from there.

    **Raises:** `ValueError` or `TypeError` before any work for unusable arguments; on Ctrl-C
    `ScanInterrupted`; `ConnectionError`, with the number of stored blocks, if the cluster is lost.
    """
    grid, verify = axes_of(axes), count("verify", verify)
    progress, paired = flag("progress", progress), flag("paired", paired)
    if store is not None:
        instance_of("store", store, (str, Path), "a path")
    sizes = [x.size for x in grid.values()]
    if paired and len({*sizes}) != 1:
        raise ValueError(
            "Argument `axes` must hold rows of one length if they are `paired`, but they have "
            f"{sizes}."
        )
    options = RunOptions(
        settle=settle, method=method, clock=clock, max_impacts=max_impacts, max_steps=max_steps
    )
    what = {"measure": measure, "start": start, "cycles": cycles, "noise": noise, "key": key}
    make = functools.partial(make_program, machine, tuple(grid), **what)
    program = make(options, derivatives=derivatives)
    place = workplace(workers, devices, cluster)
    blocks = in_blocks(program, grid, place, paired, store, lanes)
    data = computed(program, blocks, place, store, progress)
    if verify:
        better = make(dataclasses.replace(options, method=_better(program)))
        data.attrs |= _verified(data, blocks, verify, better, place, store)
    _warn_of_failures(data)
    return data


def _better(program: ScanProgram) -> AbstractMethod:
    """Return a method to verify the program's by, of steps at most half as long."""
    best, mine = preset(program.machine, "reference"), program.method
    if type(best) is type(mine) and best.steps_per_cycle <= mine.steps_per_cycle:
        return mine.tighter()
    steps = max(best.steps_per_cycle, 2 * mine.steps_per_cycle)
    return dataclasses.replace(best, steps_per_cycle=steps)


def _verified(
    data: "xr.Dataset", blocks: Blocks, lanes: int, program: ScanProgram, place: Workplace,
    store: str | Path | None,
) -> dict[str, Any]:  # fmt: skip
    """How some of the lanes, drawn by chance, come out by a better program; attributes by their
    names.

    **Arguments:** `data`, what was found, and the `store` that keeps it, if any; `lanes`, how many
    (at most all); `program`, the better one; `place`, where it is computed.
    """
    total = data["result"].size
    lanes = min(lanes, total)
    drawn = np.sort(np.random.default_rng(0).choice(total, lanes, replace=False))
    places = np.unravel_index(drawn, data["result"].shape)
    if blocks.paired:
        places = (drawn,) * len(blocks.axes)
    axes = {name: x[i] for (name, x), i in zip(blocks.axes.items(), places, strict=True)}
    numbers = None if program.lane_noise is None else lane_numbers(total)[drawn]  # their own paths
    again = in_blocks(program, axes, place, paired=True, numbers=numbers)
    kept = functools.partial(ScanInterrupted, data, store)
    with at_work("verification", kept, progress=False):
        better = computed(program, again, place)
    found: dict[str, Any] = {"verified_lanes": lanes}
    for name in better:
        mine = np.asarray(data[name]).reshape(total, -1)[drawn]
        other = np.asarray(better[name]).reshape(lanes, -1)
        if mine.dtype.kind == "f":
            same = (mine == other) | (np.isnan(mine) & np.isnan(other))
            apart = np.where(same, 0.0, np.abs(mine - other))
            worst = np.where(np.isfinite(apart), apart, np.inf).max(axis=1)
            found[f"verified_error_{name}"] = float(np.quantile(worst, 0.95, method="higher"))
        else:
            found[f"verified_changed_{name}"] = int((mine != other).any(axis=1).sum())
    return found


def _warn_of_failures(data: "xr.Dataset") -> None:
    codes, numbers = np.unique(np.asarray(data["result"]), return_counts=True)
    good = REASON_NAMES.index("successful"), REASON_NAMES.index("ended")  # an outcome is no failure
    failed = {int(c): int(n) for c, n in zip(codes, numbers, strict=True) if c not in good}
    if not failed:
        return
    names = ["not_computed", *REASON_NAMES]
    why = ", ".join(f"{names[code + 1]}: {n:,}" for code, n in failed.items())
    warnings.warn(
        f"{sum(failed.values()):,} of {data['result'].size:,} lanes failed ({why}); see `result` "
        "and `RESULTS`.",
        LanesFailed,
        stacklevel=4,
    )
