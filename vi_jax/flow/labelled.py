"""Results as labelled data sets, for what reads xarray: ArviZ, hvPlot, NetCDF, Zarr."""

import enum
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._checks import one_of
from .._types import State, xr
from ..machine import by_name, with_units


class EventKind(enum.IntEnum):
    """What may happen to a motion, as `EventLog` lists it."""

    impact = 0
    """A body hits a rigid stop."""
    rest = 1
    """A body comes to rest on a stop."""
    release = 2
    """A body leaves the stop on which it rested."""
    mode = 3
    """A switch changes its mode."""
    reset = 4
    """One of the machine's `events`."""


EVENTS = tuple(kind.name for kind in EventKind)
"""The names of what may happen to a motion, as `EventLog` lists it: an impact on a stop; a body
that comes to rest on one; a body that leaves the stop on which it rested; a switch that changes its
mode; one of the machine's `events`."""

Variables = dict[str, tuple[tuple[str, ...], np.ndarray]]


def batch_names(dims: Sequence[str] | None, number: int) -> tuple[str, ...]:
    """Names of the batch axes. **Raises:** `ValueError` if others are given than there are."""
    if dims is None:
        return ("lane",) if number == 1 else tuple(f"lane_{i}" for i in range(number))
    if isinstance(dims, str) or len(dims) != number:
        raise ValueError(
            f"Argument `dims` must name the {number} batch axes of this result, but got {dims!r}."
        )
    return tuple(dims)


def states(prefix: str, state: State, dims: tuple[str, ...]) -> Variables:
    """The components of a state, each a variable; an array among them has axes of its own."""
    found = {}
    for name, x in by_name(state).items():
        name, x = name or "state", np.asarray(x)
        inner = tuple(f"{name}_{i}" for i in range(x.ndim - len(dims)))
        found[f"{prefix}_{name}"] = (*dims, *inner), x
    return found


def present(values: Mapping[str, Any], dims: tuple[str, ...]) -> Variables:
    """The entries that are not `None`."""
    return {name: (dims, np.asarray(x)) for name, x in values.items() if x is not None}


def tidy(data: "xr.Dataset", along: str | None) -> "xr.Dataset":
    """Of a data set what lies along one of its dimensions, so that it makes a table with one
    row for each of its places; all of it by default.

    **Raises:** `ValueError` if there is no such dimension.
    """
    if along is None:
        return data
    columns = {}
    for name, x in data.data_vars.items():
        columns |= _columns(str(name), x)
    last = {name: str(x.dims[-1]) for name, x in columns.items() if x.dims}
    one_of("along", along, tuple(dict.fromkeys(last.values())))
    return data.assign(columns)[[name for name, dim in last.items() if dim == along]]


def _columns(name: str, x: Any) -> dict[str, Any]:
    """A variable, or those of the single numbers of an array of the state (see `states`)."""
    inner = [dim for dim in map(str, x.dims) if name.endswith("_" + dim.rpartition("_")[0])]
    if not inner:
        return {name: x}
    shape = [x.sizes[dim] for dim in inner]
    return {
        name + str(list(place)): x.isel(dict(zip(inner, place, strict=True)))
        for place in np.ndindex(*shape)
    }


# What tells, along these dimensions, which places of a log are used.
_LISTED = {"impact": "log_stop", "event": "event_number"}


def _met(log: Any, number: str) -> Any:
    """The entries of a log, one after the other, without unused places: those where the variable
    `number` is negative."""
    rows = log.stack(row=log[number].dims).reset_index("row")
    return rows.isel(row=np.flatnonzero(np.asarray(rows[number]) >= 0))


def run_dataset(
    run: Any, dims: Sequence[str] | None, result: np.ndarray, along: str | None
) -> "xr.Dataset":
    """A run as a data set (see `Run.to_xarray`)."""
    batch = batch_names(dims, run.steps.ndim)
    cycle, section = (*batch, "cycle"), (*batch, "section")
    names = ("y_max", "y_min", "impacts", "impact_speed", "rests", "impact_energy", "clearance",
             "duration", "frequency_ratio")  # fmt: skip
    variables = states("section", run.sections, section)
    variables |= present({name: getattr(run, name) for name in names} | run.averages, cycle)
    variables |= states("section", run.quantities, section)
    variables |= states("section", {f"mode_{i}": x for i, x in enumerate(run.modes)}, section)
    count = run.impacts.shape[-1]
    coordinates: dict[str, Any] = {
        "cycle": np.arange(1, count + 1), "section": np.arange(count + 1),
    }  # fmt: skip
    if run.samples is not None:
        sample = (*batch, "sample")
        variables |= states("sample", run.samples.state, sample)
        variables |= states("sample", run.samples.quantities, sample)
        variables["sample_time"] = sample, np.asarray(run.samples.time)
        place = np.asarray(run.samples.cycles)
        coordinates["sample"] = place.reshape(-1, place.shape[-1])[0]
    if run.impact_log is not None:
        log = (*cycle, "impact")
        kept = {f"log_{name}": getattr(run.impact_log, name) for name in ("phase", "speed", "stop")}
        variables |= present(kept, log)
    if run.event_log is not None:
        names = ("phase", "number", "value")
        kept = {f"event_{name}": getattr(run.event_log, name) for name in names}
        kept["event_kind"] = np.asarray([*EVENTS, ""])[np.asarray(run.event_log.kind)]
        variables |= present(kept, (*cycle, "event"))
    if run.errors is not None:
        variables |= states("error_section", run.errors.sections, section)
        kept = {f"error_{name}": getattr(run.errors, name) for name in ("y_max", "y_min")}
        variables |= present(kept, cycle)
    variables |= present({"result": result, "steps": run.steps, "rejected": run.rejected}, batch)
    own = {name: name for name in run.averages}
    data = tidy(with_units(xr.Dataset(variables, coordinates), dict(run.units), own), along)
    return _met(data, _LISTED[along]) if along in _LISTED else data
