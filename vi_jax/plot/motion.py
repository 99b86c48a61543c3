"""The path of a motion, and pictures of it: time histories and phase portraits."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib import rcParams, rcParamsDefault
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MultipleLocator

from .._checks import count, instance_of, one_of
from .._programs import compiled
from ..flow import Run, Samples
from ..machine import (
    PLAIN,
    AbstractMachine,
    SoftStop,
    Turn,
    component,
    components,
    counter_of,
    cycles_in_words,
    has_component,
    in_brackets,
    is_angle,
    is_autonomous,
    logged_turn,
    name_in,
    names_on,
    near_names,
    number_on,
    stops_of,
    switches_of,
    unit_of,
    units_of,
    without_modes,
    without_turns,
)
from ..orbit import Orbit
from .colors import BLUE, STOP, once, thick


def new_axes(ax: Axes | None) -> Axes:
    """Return `ax`, or the axes of a new figure, with the size that the user has set, if any."""
    if ax is not None:
        instance_of("ax", ax, Axes, "one `Axes` of matplotlib")
        return ax
    import matplotlib.pyplot as plt  # only here: given axes need no global state

    is_set = rcParams["figure.figsize"] != rcParamsDefault["figure.figsize"]
    size = None if is_set else (7, 3.5)
    return plt.subplots(figsize=size, layout="constrained")[1]


class MotionPath(NamedTuple):
    """Points of a motion in their order, as NumPy arrays of one length."""

    cycles: np.ndarray
    """Clock of the drive, in cycles since the start (crank angle over 2π)."""
    Y: np.ndarray
    """Position, which stops limit (unit: the machine's; a for a `Scene`)."""
    V: np.ndarray
    """Velocity, which an impact reverses (unit: the machine's; a ω for a `Scene`)."""


def motion_path(
    motion: Run | Samples,
    *,
    machine: AbstractMachine | None = None,
    window: tuple[float | int, float | int] | None = None,
    coordinate: int | str = 0,
) -> MotionPath:
    """Return the path of one sampled motion.

    **Arguments:** `motion`, a `Run` simulated with `samples=...` (or its `Samples`); `machine`,
    with which each logged impact (`impact_log=...`) adds two points, before and after it, for exact
    corners at stops; `window`, the first and the last cycle to keep; `coordinate`, by number or by
    name, with its own impacts.

    **Raises:** `ValueError` for a run without samples, a batch, or an unknown coordinate; or
    without a machine for states without `Y` and `V`.
    """
    if isinstance(motion, Orbit):
        raise TypeError("Argument `motion` must be a `Run`: give `orbit.trajectory()` of an orbit.")
    instance_of("motion", motion, (Run, Samples), "a `Run`, from `simulate`, or its `samples`")
    if machine is not None:
        instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    coordinate, samples = coordinate_of(machine, coordinate), samples_of(motion)
    cycles = np.asarray(samples.cycles, float)
    if cycles.ndim != 1:
        raise ValueError(
            f"Argument `motion` must be one motion, but is a batch of shape {cycles.shape[:-1]}."
        )
    try:
        columns = _coordinate_path(machine, coordinate, samples.state)
        path = MotionPath(cycles, *(np.asarray(x, float) for x in columns))
    except (AttributeError, LookupError):
        raise ValueError(
            "Argument `machine` must be given for states without `Y` and `V`: it defines the "
            "position."
            if not isinstance(coordinate, str)
            else f"Argument `coordinate` must be a number or a component of the state, but got "
            f"{coordinate!r}; {near_names(coordinate, list(components(samples.state, 1)))}."
        ) from None
    if isinstance(motion, Run) and motion.impact_log is not None and machine is not None:
        path = _with_impacts(path, motion, machine, coordinate)
    if window is not None:
        keep = (path.cycles >= window[0]) & (path.cycles <= window[1])
        path = MotionPath(*(x[keep] for x in path))
    return path


def samples_of(motion: Run | Samples) -> Samples:
    """Return the samples of a motion. **Raises:** `ValueError` for a run without any."""
    samples = motion.samples if isinstance(motion, Run) else motion
    if samples is None:
        raise ValueError("Argument `motion` must have samples. Simulate with `samples=64`.")
    return samples


def drawn_path(
    motion: Run | Samples, *, machine: AbstractMachine | None, **about: Any
) -> MotionPath:
    """Return the path for a picture: an angle is reduced to a turn, and its line is broken where it
    passes half a turn. Arguments and errors are those of `motion_path`."""
    path = motion_path(motion, machine=machine, **about)
    if machine is None or not turns(motion, machine, about["coordinate"]):
        return path
    Y = without_turns(path.Y)
    breaks = np.flatnonzero(np.abs(np.diff(Y)) > np.pi) + 1
    gap = MotionPath(path.cycles[breaks - 1], *np.full((2, breaks.size), np.nan))
    pairs = zip(path._replace(Y=Y), gap, strict=True)
    return MotionPath(*(np.insert(a, breaks, b) for a, b in pairs))


def turns(motion: Run | Samples, machine: AbstractMachine, coordinate: int | str) -> bool:
    """Return whether a coordinate is an angle of `wrap_angles` or `turn_of`."""
    samples = samples_of(motion)
    Y = _coordinate_path(machine, coordinate_of(machine, coordinate), samples.state)[0]
    counter = counter_of(machine)
    turn = counter.name if isinstance(counter, Turn) else None
    named = components(without_modes(samples.state), lead=1).items()
    angles = (x for name, x in named if name == turn or is_angle(machine, name))
    return any(np.array_equal(Y, angle, equal_nan=True) for angle in angles)


def _coordinate_path(machine: AbstractMachine | None, k: int | str, states: Any) -> tuple[Any, Any]:
    """Return position and velocity of states by coordinate number k, or the component with that
    name; without a machine `Y` and `V`."""
    if isinstance(k, str):
        rate = f"v.{k}"  # of a `Mechanical`
        return jax.vmap(
            lambda z: (component(k, z), component(rate if has_component(rate, z) else k, z))
        )(states)
    return (states.Y, states.V) if machine is None else _by_number(machine, k, states)


@compiled
def _by_number(machine: AbstractMachine, k: int, states: Any) -> tuple[Any, Any]:
    body = machine if k == 0 else machine.coordinates[k]
    return jax.vmap(body.position)(states), jax.vmap(body.velocity)(states)


def coordinate_of(machine: AbstractMachine | None, coordinate: int | str) -> int | str:
    """Return the number of a coordinate, also by its name, or the name if no contact limits it.
    **Raises:** `ValueError` for a number that the machine does not have."""
    if isinstance(coordinate, str):
        number = None if machine is None else number_on(machine, coordinate)
        return coordinate if number is None else number
    most = 0 if machine is None else len(machine.coordinates) - 1
    return count("coordinate", coordinate, most=most)


def _with_impacts(
    path: MotionPath, run: Run, machine: AbstractMachine, coordinate: int | str
) -> MotionPath:
    log = run.impact_log
    assert log is not None
    stop, stops = np.asarray(log.stop), stops_of(machine)
    stop_numbers = [i for i, x in enumerate(stops) if x.coordinate == coordinate]
    logged = np.isin(stop, stop_numbers)
    cycle, _ = np.nonzero(logged)
    stop = stop[logged]
    if not stop.size:
        return path
    length = np.full(run.impacts.shape, float(logged_turn(machine)))
    if is_autonomous(machine, run.last):  # cycles of different lengths
        length = np.asarray(run.duration)
    cycles_at = cycle + np.asarray(log.phase)[logged] / length[cycle]
    speed = np.asarray(log.speed)[logged]
    stops_hit = [stops[i] for i in stop]
    before = np.array([s.sign for s in stops_hit]) * speed
    hit = [_place_and_rebound(s, v) for s, v in zip(stops_hit, before, strict=True)]
    places, after = np.reshape(np.array(hit, float), (-1, 2)).T
    added = MotionPath(
        np.repeat(cycles_at, 2), np.repeat(places, 2), np.stack([before, after], axis=1).ravel()
    )
    index = np.searchsorted(path.cycles, added.cycles)
    return MotionPath(*(np.insert(a, index, b) for a, b in zip(path, added, strict=True)))


@compiled
def _place_and_rebound(stop: Any, velocity: Any) -> Any:
    return stop.place, stop.velocity_after(velocity)


def counts_by_angle(machine: AbstractMachine | None) -> bool:
    """Return whether periods are in crank angle, as for the paper's machine or no machine."""
    return machine is None or cycles_in_words(machine, 1) == "2π"


def plot_history(
    motion: Run | Samples,
    *,
    machine: AbstractMachine | None = None,
    ax: Axes | None = None,
    window: tuple[float | int, float | int] | None = None,
    shift: float | int = 0,
    unit: str | None = None,
    stops: bool = True,
    coordinate: int | str = 0,
    **style: Any,
) -> Axes:
    """Draw position over the drive's clock, with the stops of `machine` as lines (dashed if soft).
    An angle of `wrap_angles` or `turn_of` is drawn within [-π, π].

    **Arguments:**

    - `motion`: a `Run` simulated with `samples=...`, or its `Samples`.
    - `machine`: the machine, for its stops and for impacts logged in the run.
    - `ax`: axes to draw into; by default a new figure.
    - `window`: the first and the last cycle to draw.
    - `shift`: the number of cycles by which to move the motion along the axis.
    - `unit`: `"angle"` (crank angle φ in units of π), `"cycles"` or `"time"`; by default the angle
      for the paper's machine or without a machine, time for a machine without a drive or one that
      is observed at equal intervals, cycles for any other.
    - `stops`: whether to draw the stops.
    - `coordinate`: the coordinate to draw, by number or by name, with its own stops and impacts.
    - `style`: options of `Axes.plot`.
    """
    path = drawn_path(motion, machine=machine, window=window, coordinate=coordinate)
    turning, samples = counts_by_angle(machine), samples_of(motion)
    if unit is None:
        unit = "angle" if turning else "time" if _without_drive(machine, samples) else "cycles"
    one_of("unit", unit, ("angle", "cycles", "time"))
    ax, x = new_axes(ax), path.cycles + shift
    if unit == "angle":
        x = 2.0 * x
    elif unit == "time":
        ends = np.asarray(samples.cycles)[-1], np.asarray(samples.time)[-1]
        x = np.interp(path.cycles, samples.cycles, samples.time) + shift * ends[1] / ends[0]
    ax.plot(x, path.Y, **{"color": BLUE, "lw": thick(1.3), **style})
    if stops and machine is not None:
        _draw_stops(machine, coordinate_of(machine, coordinate), ax, ax.axhline)
    ax.set_ylabel(_labels(motion, machine, coordinate)[0])
    if unit == "angle":
        angle_axis(ax)
    elif unit == "cycles":
        ax.set_xlabel("drive cycles φ/(2π)" if turning else "cycles since the start")
    else:
        time = unit_of({} if machine is None else units_of(machine), "time")
        ax.set_xlabel(in_brackets("time since the start", time))
    return ax


def _without_drive(machine: AbstractMachine | None, samples: Samples) -> bool:
    """Return whether the cycles of a run are no cycles of a drive."""
    if machine is None:
        return False
    start = jax.tree.map(lambda x: np.asarray(x)[0], samples.state)
    return hasattr(machine, "observed_interval") or is_autonomous(machine, start)


def _draw_stops(
    machine: AbstractMachine, coordinate: int | str, ax: Axes, line: Callable[..., Any]
) -> None:
    """Draw rigid stops as thick lines, and soft ones as dashed lines."""
    for stop in all_stops(machine, coordinate):
        look = {"lw": thick(1.8), "label": once(ax, "stop")}
        if isinstance(stop, SoftStop):
            look = {"lw": thick(1.2), "ls": "--", "label": once(ax, "soft stop")}
        line(float(stop.place), color=STOP, **look)


def all_stops(machine: AbstractMachine, coordinate: int | str | None = None) -> list[Any]:
    """Return the rigid and then the soft stops of a machine, or of one coordinate."""
    soft = (switch for switch in switches_of(machine) if isinstance(switch, SoftStop))
    both = (*stops_of(machine), *soft)
    return [stop for stop in both if coordinate is None or stop.coordinate == coordinate]


def _labels(
    motion: Run | Samples, machine: AbstractMachine | None, coordinate: int | str
) -> tuple[str, str]:
    """Return the names of position and velocity, with units; samples have no machine."""
    if machine is None:
        return motion.labels if isinstance(motion, Run) else ("Y", "V")
    names, labels = PLAIN, machine.labels
    if isinstance(coordinate, str):
        names = labels = (coordinate, f"v.{coordinate}")
    elif coordinate:  # the machine's labels are for the first
        plain = tuple(f"{name} of coordinate {coordinate}" for name in PLAIN)
        labels = names_on(machine, coordinate) or plain
    position, velocity = (
        in_brackets(label, unit_of(units_of(machine), name)) if name_in(label) == label else label
        for name, label in zip(names, labels, strict=True)
    )
    return position, velocity


def angle_axis(ax: Axes, *, every: int = 1) -> None:
    """Label an axis with the crank angle in units of π, at multiples of `every`."""
    ax.set_xlabel("crank angle φ")
    ax.xaxis.set_major_locator(MultipleLocator(every))
    ax.xaxis.set_major_formatter(FuncFormatter(_multiple_of_pi))


def _multiple_of_pi(value: float | int, _: int | None = None) -> str:
    whole = round(value)
    return {0: "0", 1: "π", -1: "-π"}.get(whole, f"{whole}π")


def plot_phase_portrait(
    motion: Run | Samples,
    machine: AbstractMachine | None = None,
    *,
    ax: Axes | None = None,
    window: tuple[float | int, float | int] | None = None,
    sections: bool = True,
    coordinate: int | str = 0,
    **style: Any,
) -> Axes:
    """Draw velocity over position, with the stops as lines (dashed if soft) and sections as dots.

    **Arguments:** as for `plot_history`; `sections`, whether to mark the state after each whole
    cycle. With an impact log, an impact is the vertical line along the stop from V to -k V.
    """
    path = drawn_path(motion, machine=machine, window=window, coordinate=coordinate)
    ax = new_axes(ax)
    (line,) = ax.plot(path.Y, path.V, **{"color": BLUE, "lw": thick(1.0), **style})
    if sections:
        unlogged = samples_of(motion)  # without the impacts
        samples = drawn_path(unlogged, machine=machine, window=window, coordinate=coordinate)
        whole = abs(samples.cycles - samples.cycles.round()) < 1e-9
        dots = {"ms": 4, "color": line.get_color(), "zorder": 3, "label": once(ax, "section")}
        ax.plot(samples.Y[whole], samples.V[whole], "o", **dots)
    if machine is not None:
        _draw_stops(machine, coordinate_of(machine, coordinate), ax, ax.axvline)
    position, velocity = _labels(motion, machine, coordinate)
    ax.set(xlabel=position, ylabel=velocity)
    return ax
