"""Time histories and phase portraits of single motions."""

from collections.abc import Callable
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, MultipleLocator

from .._checks import instance_of
from ..flow import Run, Samples
from ..machine import (
    PLAIN,
    AbstractMachine,
    SoftStop,
    cycles_in_words,
    in_brackets,
    name_in,
    names_on,
    stops_of,
    switches_of,
    unit_of,
    units_of,
)
from .colors import BLUE, STOP, is_set, once, thick
from .path import coordinate_of, drawn_path


def new_axes(ax: Axes | None) -> Axes:
    """`ax`, or the axes of a new figure, of the size that was set for figures if one was."""
    if ax is not None:
        instance_of("ax", ax, Axes, "one `Axes` of matplotlib")
        return ax
    import matplotlib.pyplot as plt  # only here, so that drawing into given axes has no state

    size = None if is_set("figure.figsize") else (7, 3.5)
    return plt.subplots(figsize=size, layout="constrained")[1]


def counts_by_angle(machine: AbstractMachine | None) -> bool:
    """Whether a machine states its periods in crank angle, as the paper's does (and none given)."""
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
    - `ax`: axes to draw into; a new figure if left out.
    - `window`: the first and the last cycle to draw.
    - `shift`: cycles by which to move the motion along the axis.
    - `unit`: `"angle"` (crank angle φ in units of π) or `"cycles"`; by default the clock of the
      `machine`, which is the angle for the paper's machine and where no machine is given.
    - `stops`: whether to draw the stops.
    - `coordinate`: the coordinate to draw, by number or by name, with its own stops and impacts.
    - `style`: options of `Axes.plot`.

    **Returns:** the axes.
    """
    path = drawn_path(motion, machine=machine, window=window, coordinate=coordinate)
    turning = counts_by_angle(machine)
    if unit is None:
        unit = "angle" if turning else "cycles"
    if unit not in ("angle", "cycles"):
        raise ValueError(f"Argument `unit` must be 'angle' or 'cycles', but got {unit!r}.")
    ax = new_axes(ax)
    factor = 2.0 if unit == "angle" else 1.0
    ax.plot(factor * (path.cycles + shift), path.Y, **{"color": BLUE, "lw": thick(1.3), **style})
    if stops and machine is not None:
        _draw_stops(machine, coordinate_of(machine, coordinate), ax, ax.axhline)
    ax.set_ylabel(_labels(motion, machine, coordinate)[0])
    if unit == "cycles":
        ax.set_xlabel("drive cycles φ/(2π)" if turning else "cycles since the start")
    else:
        angle_axis(ax)
    return ax


def _draw_stops(
    machine: AbstractMachine, coordinate: int | str, ax: Axes, line: Callable[..., Any]
) -> None:
    """Of a coordinate the rigid stops as thick lines, and the soft ones, which the body goes into,
    as thin dashed ones."""
    for stop in all_stops(machine, coordinate):
        look = {"lw": thick(1.8), "label": once(ax, "stop")}
        if isinstance(stop, SoftStop):
            look = {"lw": thick(1.2), "ls": "--", "label": once(ax, "soft stop")}
        line(float(stop.place), color=STOP, **look)


def all_stops(machine: AbstractMachine, coordinate: int | str | None = None) -> list[Any]:
    """The rigid and then the soft stops of a machine; of one coordinate, if it is given."""
    soft = (switch for switch in switches_of(machine) if isinstance(switch, SoftStop))
    both = (*stops_of(machine), *soft)
    return [stop for stop in both if coordinate is None or stop.coordinate == coordinate]


def _labels(
    motion: Run | Samples, machine: AbstractMachine | None, coordinate: int | str
) -> tuple[str, str]:
    """What position and velocity of a coordinate are called, with their units; samples alone do not
    know their machine."""
    if machine is None:
        return motion.labels if isinstance(motion, Run) else ("Y", "V")
    labels = machine.labels
    if isinstance(coordinate, str):
        place, rate = (
            in_brackets(name, unit_of(units_of(machine), name))
            for name in (coordinate, f"v.{coordinate}")
        )
        return place, rate
    if coordinate:  # the machine's words are those of the first
        plain = tuple(f"{name} of coordinate {coordinate}" for name in PLAIN)
        labels = names_on(machine, coordinate) or plain
    named = zip(PLAIN, labels, strict=True)
    position, velocity = (
        in_brackets(label, unit_of(units_of(machine), name)) if name_in(label) == label else label
        for name, label in named
    )
    return position, velocity


def angle_axis(ax: Axes, *, every: int = 1) -> None:
    """Label an axis that counts the crank angle in units of π, at multiples of `every`."""
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

    **Arguments:** as for `plot_history`; `sections` marks the state after each whole cycle. An
    impact is the vertical line along the stop from V to -k V (if the run has an impact log).

    **Returns:** the axes.
    """
    path = drawn_path(motion, machine=machine, window=window, coordinate=coordinate)
    ax = new_axes(ax)
    (line,) = ax.plot(path.Y, path.V, **{"color": BLUE, "lw": thick(1.0), **style})
    if sections:
        only = motion.samples if isinstance(motion, Run) else motion  # without the impacts
        assert only is not None
        samples = drawn_path(only, machine=machine, window=window, coordinate=coordinate)
        whole = abs(samples.cycles - samples.cycles.round()) < 1e-9
        dots = {"ms": 4, "color": line.get_color(), "zorder": 3, "label": once(ax, "section")}
        ax.plot(samples.Y[whole], samples.V[whole], "o", **dots)
    if machine is not None:
        _draw_stops(machine, coordinate_of(machine, coordinate), ax, ax.axvline)
    position, velocity = _labels(motion, machine, coordinate)
    ax.set(xlabel=position, ylabel=velocity)
    return ax
