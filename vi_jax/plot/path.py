"""A sampled run as a path to draw, with its impacts inserted between the samples."""

from typing import Any, NamedTuple

import jax
import numpy as np

from .._checks import count, instance_of
from .._programs import compiled
from ..flow import Run, Samples
from ..machine import (
    AbstractMachine,
    Turn,
    bare,
    component,
    components,
    counter_of,
    has_component,
    is_angle,
    is_autonomous,
    logged_turn,
    number_on,
    stops_of,
    without_turns,
)
from ..orbit import Orbit


def _course(machine: AbstractMachine | None, k: int | str, states: Any) -> tuple[Any, Any]:
    """Position and velocity of states by coordinate number k, or the component of that name;
    without a machine their components `Y` and `V`."""
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


class MotionPath(NamedTuple):
    """Points of a motion in their order, as NumPy arrays of one length."""

    cycles: np.ndarray
    """Place on the drive's clock, in cycles since the start (crank angle over 2π)."""
    Y: np.ndarray
    """Position: what the stops limit (unit: the machine's; a for a `Scene`)."""
    V: np.ndarray
    """Velocity: what an impact reverses (unit: the machine's; a ω for a `Scene`)."""


def motion_path(
    motion: Run | Samples,
    *,
    machine: AbstractMachine | None = None,
    window: tuple[float | int, float | int] | None = None,
    coordinate: int | str = 0,
) -> MotionPath:
    """Return the path of one sampled motion.

    **Arguments:** a `Run` simulated with `samples=...` (or its `Samples`); with the `machine`, the
    impacts logged (`impact_log=...`) enter as two points each, before and after the impact, so
    that a corner at the stop is drawn where it is; `window`, the first and the last cycle to keep;
    `coordinate`, the number or the name of the coordinate whose path it is, with its own impacts.

    **Raises:** `ValueError` if the run has no samples or is a batch, if its states lack `Y` and `V`
    without a machine that replaces them, or for an unknown coordinate.
    """
    if isinstance(motion, Orbit):
        raise TypeError("Argument `motion` must be a `Run`: give `orbit.trajectory()` of an orbit.")
    instance_of("motion", motion, (Run, Samples), "a `Run`, from `simulate`, or its `samples`")
    if machine is not None:
        instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    coordinate = coordinate_of(machine, coordinate)
    samples = motion.samples if isinstance(motion, Run) else motion
    if samples is None:
        raise ValueError("Argument `motion` must have samples. Simulate with `samples=64`.")
    cycles = np.asarray(samples.cycles, float)
    if cycles.ndim != 1:
        raise ValueError(
            f"Argument `motion` must be one motion, but is a batch of shape {cycles.shape[:-1]}."
        )
    try:
        course = _course(machine, coordinate, samples.state)
        path = MotionPath(cycles, *(np.asarray(x, float) for x in course))
    except (AttributeError, LookupError):
        raise ValueError(
            "Argument `machine` must be given for states without `Y` and `V`: it defines the "
            "position."
            if not isinstance(coordinate, str)
            else f"Argument `coordinate` must be a number or a component of the state, but got "
            f"{coordinate!r}."
        ) from None
    if isinstance(motion, Run) and motion.impact_log is not None and machine is not None:
        path = _with_impacts(path, motion, machine, coordinate)
    if window is not None:
        keep = (path.cycles >= window[0]) & (path.cycles <= window[1])
        path = MotionPath(*(x[keep] for x in path))
    return path


def drawn_path(
    motion: Run | Samples, *, machine: AbstractMachine | None, **about: Any
) -> MotionPath:
    """The path that a picture draws: that of an angle lies within a turn, and its line is broken
    where it passes half a turn.

    **Arguments and raises:** as `motion_path`.
    """
    path = motion_path(motion, machine=machine, **about)
    if machine is None or not turns(motion, machine, about["coordinate"]):
        return path
    Y = without_turns(path.Y)
    at = np.flatnonzero(np.abs(np.diff(Y)) > np.pi) + 1
    gap = MotionPath(path.cycles[at - 1], *np.full((2, at.size), np.nan))
    pairs = zip(path._replace(Y=Y), gap, strict=True)
    return MotionPath(*(np.insert(a, at, b) for a, b in pairs))


def turns(motion: Run | Samples, machine: AbstractMachine, coordinate: int | str) -> bool:
    """Whether a coordinate is one of the machine's angles, of `wrap_angles` or `turn_of`."""
    samples = motion.samples if isinstance(motion, Run) else motion
    assert samples is not None
    Y = _course(machine, coordinate_of(machine, coordinate), samples.state)[0]
    counter = counter_of(machine)
    turn = counter.name if isinstance(counter, Turn) else None
    named = components(bare(samples.state), lead=1).items()
    angles = (x for name, x in named if name == turn or is_angle(machine, name))
    return any(np.array_equal(Y, angle, equal_nan=True) for angle in angles)


def coordinate_of(machine: AbstractMachine | None, coordinate: int | str) -> int | str:
    """The number of a coordinate, by its name too; the name of one that no contact limits.

    **Raises:** `ValueError` for a number that the machine has not.
    """
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
    own = [i for i, x in enumerate(stops) if x.coordinate == coordinate]
    logged = np.isin(stop, own)
    cycle, _ = np.nonzero(logged)
    stop = stop[logged]
    if not stop.size:
        return path
    length = np.full(run.impacts.shape, float(logged_turn(machine)))
    if is_autonomous(machine, run.last):  # whose cycles are of several lengths
        length = np.asarray(run.duration)
    at = cycle + np.asarray(log.phase)[logged] / length[cycle]
    speed = np.asarray(log.speed)[logged]
    hit = [stops[i] for i in stop]
    before = np.array([s.sign for s in hit]) * speed
    after = [float(s.rebound(v)) for s, v in zip(hit, before, strict=True)]
    extra = MotionPath(
        np.repeat(at, 2),
        np.repeat([float(s.place) for s in hit], 2),
        np.stack([before, after], axis=1).ravel(),
    )
    places = np.searchsorted(path.cycles, extra.cycles)
    return MotionPath(*(np.insert(a, places, b) for a, b in zip(path, extra, strict=True)))
