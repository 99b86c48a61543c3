"""A machine on the page: sliders of its numbers, its motions and its diagrams.

Every number of the machine and of the start is traced, so that all values use one program.
"""

import inspect
import time
import timeit
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .. import machines
from .._checks import fields_with, interval
from .._messages import count_of
from .._programs import compiled
from .._types import State
from ..flow import RESULTS, Run, chosen, simulate
from ..machine import (
    AbstractMachine,
    check_again,
    components,
    convert_start,
    cycles_in_words,
    in_brackets,
    is_autonomous,
    raveled,
    unit_of,
    with_leaves,
    with_unit,
)
from ..machines import Parameters, Scene
from ..orbit import STABILITY, cycle_map, multipliers_in_words, multipliers_of, stability_of
from ..plot import MotionPath, axis_name, motion_path
from ..scans import REGIMES, Regime, lyapunov, moved_by_stops

START, SETTLE = "start.", "cycles before"
"""The prefix of the start's sliders, and the name of that of the cycles before the drawn ones."""

ACROSS, CYCLES = 241, 16
"""Values across a diagram, and drawn cycles of each."""

SHOWN = {
    "least position in a cycle": "low", "position on the section": "position",
    "velocity on the section": "velocity", "fastest impact in a cycle": "speed",
}  # fmt: skip
"""The choices of a diagram's ordinate, with the arrays of a `Diagram`."""

# Steps of a slider; the most automatic sliders; seconds of computation for a redrawing, which with
# marimo's work takes less than 0.2; the most cycles before the drawn ones. Choices.
_STEPS, _MOST, _PATIENCE, _LONGEST = 400, 40, 0.1, 1000

# Cycles for a measurement of the time of one; the fewest cycles; and rounding of a slider.
_TRIED, _FEWEST, _ROUNDING = 40, 20, 1e-9

WINDOW = 8
"""Drive cycles drawn as a motion."""

OBSERVED = 256
"""Drive cycles observed for the maps, the regime and the multipliers."""

# As for scans, but shorter: choices.
_REGIME = Regime(longest=32, observed=128, lasting=0)

# Samples of a cycle; its impacts that are drawn, and those in the impact map.
_SAMPLES, _DRAWN, _MAPPED = 48, 8, 4

# Multipliers this near to 1 in size, or to the real axis, count as on it.
_NEUTRAL = 1e-7

# The most steps of a motion, so that no slider waits for long.
_MOST_STEPS = 400_000


class Motion(NamedTuple):
    """One motion as NumPy arrays."""

    machine: AbstractMachine
    path: MotionPath
    """The motion over `WINDOW` cycles, with its impacts."""
    impact_phase: np.ndarray
    """Phase of each observed impact, as in an impact log (radians for a `Scene`)."""
    impact_speed: np.ndarray
    """Speed V⁻ before each observed impact (unit: the machine's)."""
    frequency_ratio: np.ndarray
    """ζ of each observed cycle."""
    extremes: tuple[float, float]
    """Smallest and greatest position over the observed cycles."""
    period: int
    """Period in drive cycles, or one of `REGIMES`."""
    impacts: float
    """Impacts in a period; without a period, the mean per cycle."""
    multipliers: np.ndarray
    """Floquet multipliers, the greatest first; empty without a period."""
    exponent: float
    """Greatest Lyapunov exponent without a period, else NaN."""
    fault: str
    """The reason of a failure; empty after success."""
    places: tuple[np.ndarray, np.ndarray]
    """Position and velocity on the sections of the observed cycles."""
    quantities: dict[str, float]
    """The machine's own quantities on the last section, and its averages over the cycles."""
    window: Run
    """The cycles that the page draws, with dense samples."""

    @property
    def regime(self) -> str:
        """The regime in words: its period and impacts, or the kind of a motion without a period."""
        if self.period > 0:
            impacts = count_of(round(self.impacts), "impact")
            return f"period {cycles_in_words(self.machine, self.period)} with {impacts}"
        kind = REGIMES(self.period).meaning
        if self.period == REGIMES.failed:
            return kind
        if self.period == REGIMES.unsettled:
            longest = cycles_in_words(self.machine, _REGIME.longest)
            kind = f"no period up to {longest}: still settling, or quasi-periodic"
        return f"{kind}, {self.impacts:.2f} impacts in a cycle"

    @property
    def stability(self) -> str:
        """The multipliers, or the exponent, in words."""
        if self.period <= 0:
            if self.fault or not np.isfinite(self.exponent):
                return ""
            rate = unit_of(self.machine.units, "rate")
            return with_unit(f"greatest Lyapunov exponent {self.exponent:.4f}", rate)
        if not np.isfinite(self.multipliers).all():
            return "no multipliers: an impact falls on the section"
        verdict = STABILITY[stability_of(jnp.asarray(self.multipliers))]
        if abs(abs(self.multipliers[0]) - 1) < _NEUTRAL:
            verdict = STABILITY[STABILITY.neutral]
        values = ", ".join(multipliers_in_words(self.multipliers, 4, _NEUTRAL))
        return f"multipliers {values}: {verdict}"


def look(scene: AbstractMachine, start: State, settle: int = 1000) -> Motion:
    """Return the motion after `settle` cycles; a start beyond a stop is moved onto it."""
    run, window, found, multipliers, places = _observe(scene, start, jnp.asarray(float(settle)))
    period = int(found["period"])
    exponent = np.nan
    if period == REGIMES.unsettled:
        exponent = _exponent_of(scene, run.last)
        if exponent > _REGIME.threshold:
            period = int(REGIMES.chaotic)
    log, ratio = run.impact_log, run.frequency_ratio
    assert log is not None and run.y_min is not None and run.y_max is not None
    numbers = {name: x[-1] for name, x in run.quantities.items()}
    numbers |= {name: x.mean() for name, x in run.averages.items()}
    is_logged = np.asarray(log.stop) >= 0
    return Motion(
        machine=scene,
        path=motion_path(window, machine=observed_evenly(scene, run.last)),
        impact_phase=np.asarray(log.phase)[is_logged],
        impact_speed=np.asarray(log.speed)[is_logged],
        frequency_ratio=np.full(OBSERVED, np.nan) if ratio is None else np.asarray(ratio),
        extremes=(float(np.min(run.y_min)), float(np.max(run.y_max))),
        period=period,
        impacts=float(found["impacts"]),
        multipliers=np.asarray(multipliers) if period > 0 else np.empty(0, complex),
        exponent=exponent,
        fault="" if bool(run.successful) else str(RESULTS[run.result]),
        places=(np.asarray(places[0]), np.asarray(places[1])),
        quantities={name: float(x) for name, x in numbers.items() if not np.ndim(x)},
        window=window,
    )


@compiled
def _observe(scene: AbstractMachine, start: State, settle: Any) -> tuple[Run, Run, Any, Any, Any]:
    """Return the observed run, its first cycles sampled, regime, multipliers, section points."""
    method = chosen(scene, None)
    options = {"method": method, "max_steps": _MOST_STEPS}
    start = moved_by_stops(scene, convert_start(scene, start))
    run = simulate(scene, start, OBSERVED, settle=settle, impact_log=_MAPPED, **options)
    first = jtu.tree_map(lambda x: x[0], run.sections)
    window = simulate(
        observed_evenly(scene, first), first, WINDOW, samples=_SAMPLES, impact_log=_DRAWN, **options
    )
    found = _REGIME(scene, run)
    places = tuple(jax.vmap(f)(run.sections) for f in (scene.position, scene.velocity))
    multipliers = multipliers_of(_monodromy(scene, run, found["period"], method))
    return run, window, found, multipliers, places


def observed_evenly(machine: AbstractMachine, state: State) -> AbstractMachine:
    """Return the machine; an autonomous one is observed at equal intervals, for samples."""
    if not is_autonomous(machine, state):
        return machine
    return machine.observed_every(jnp.asarray(machine.cycle))


def _monodromy(scene: AbstractMachine, run: Run, period: Any, method: Any) -> jax.Array:
    """Return the derivative of the map over the last `period` cycles, cycle by cycle."""
    the_map = cycle_map(scene, method=method)
    cycles = jnp.maximum(period, 0).astype(jnp.int32)

    def one(i, product):
        place = OBSERVED - cycles + i
        return the_map.jacobian(jtu.tree_map(lambda x: x[place], run.sections)) @ product

    row = raveled(run.last)[0]
    return jax.lax.fori_loop(0, cycles, one, jnp.eye(row.size, dtype=row.dtype))


def _exponent_of(scene: AbstractMachine, state: State) -> float:
    """Return the greatest exponent; NaN for a machine with a section and `renewed`."""
    try:
        return float(lyapunov(scene, state, _REGIME.observed, settle=0, number=1).exponents[0])
    except ValueError:
        return float("nan")


class Control(NamedTuple):
    """A slider: its label, range, step and first value."""

    label: str
    low: float
    high: float
    step: float
    value: float


class Diagram(NamedTuple):
    """Attractors from one start over one parameter; arrays of shape (values, cycles)."""

    label: str
    values: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    low: np.ndarray
    speed: np.ndarray


class Subject:
    """A machine whose numbers are sliders.

    **Arguments:** `machine`; `ranges` of some of its numbers and of its start (`"start.Y"`). They
    override the machine's own `slider_ranges`, if any. The default is from zero to twice the value,
    within the allowed range.

    **Raises:** `ValueError` for a range of an unknown number, or a wrong range.
    """

    def __init__(
        self, machine: AbstractMachine, ranges: Mapping[str, tuple[float, float]] | None = None
    ):
        self.machine, self.start = machine, convert_start(machine, machine.start())
        given_ranges = {**getattr(machine, "slider_ranges", {}), **(ranges or {})}
        real = lambda x: jnp.issubdtype(jnp.result_type(x), jnp.floating)
        numbers = {name: float(x) for name, x in components(machine).items() if real(x)}
        begin = {f"{START}{name}": float(x) for name, x in components(self.start).items()}
        for name in given_ranges:
            if name not in numbers and name not in begin:
                known = ", ".join([*numbers, *begin])
                raise ValueError(f"A range must be of a number of the machine ({known}), "
                                 f"but is of {name!r}.")  # fmt: skip
        first = sorted(numbers, key=lambda name: name not in given_ranges)[:_MOST]
        self.names = tuple(name for name in numbers if name in first)
        """The names of the machine's numbers with sliders."""
        self.controls: dict[str, Control] = {}
        for name, value in {**{x: numbers[x] for x in self.names}, **begin}.items():
            low, high = _range_of(machine, name, value)
            if name in given_ranges:
                low, high = interval(f"ranges[{name!r}]", given_ranges[name])
            low, high = min(low, value), max(high, value)
            low, step = _grid(low, high, value)
            self.controls[name] = Control(_label(machine, name, numbers), low, high, step, value)
        self.controls[SETTLE] = Control(SETTLE, 0.0, _LONGEST, 1.0, 0.0)
        self.before = 0
        """The cycles before the drawn ones of a diagram: as many as the time allows."""
        self._kept: tuple[Any, Any] = None, None

    def at(self, values: Mapping[str, Any]) -> tuple[AbstractMachine, Any]:
        """Return machine and start at these values of the sliders. **Raises:** `ValueError` for
        values outside of a slider, or that the machine does not allow."""
        for name, (label, low, high, _, _) in self.controls.items():
            x = values.get(name)
            if not (isinstance(x, int | float) and low - _ROUNDING <= x <= high + _ROUNDING):
                raise ValueError(
                    f"The {label} must be a number from {low:g} to {high:g}, but is {x!r}."
                )
        moved = [name for name in self.names if values[name] != self.controls[name].value]
        machine = with_leaves(self.machine, {name: float(values[name]) for name in moved})
        check_again(machine)
        begin = {name: float(values[START + name]) for name in components(self.start)}
        return machine, with_leaves(self.start, begin)

    def motion_at(self, values: Mapping[str, Any]) -> Motion:
        """Return the motion at these values of the sliders."""
        return look(*self.at(values), int(values[SETTLE]))

    def compile(self, report: Callable[[str], None]) -> None:
        """Compile the programs of the sliders, and fit the number of cycles before the drawn ones
        to their speed on this computer."""
        report(f"compiling the {type(self.machine).__name__}")
        start = self.at(self.first_values())[1]
        _exponent_of(self.machine, look(self.machine, start, 0).window.last)
        fits = _affordable_cycles(lambda cycles: look(self.machine, start, cycles))
        self.controls[SETTLE] = Control(SETTLE, 0.0, float(fits), 1.0, float(min(300, fits)))

    def first_values(self) -> dict[str, float]:
        """Return the first value of each slider, by name."""
        return {name: control.value for name, control in self.controls.items()}

    def diagram(self, values: Mapping[str, Any], parameter: str) -> Diagram:
        """Return the attractors from the start over one of the machine's numbers, kept while the
        others do not change. The first call compiles."""
        key = [(name, x) for name, x in values.items() if name not in (parameter, SETTLE)]
        if self._kept[0] != (parameter, key):
            machine, start = self.at(values)
            control = self.controls[parameter]
            across = np.linspace(control.low, control.high, ACROSS)
            row = jnp.array([float(values[name]) for name in self.names])
            rows = jnp.tile(row, (ACROSS, 1)).at[:, self.names.index(parameter)].set(across)

            def found(cycles: int) -> Any:
                settle = jnp.asarray(float(cycles))
                return jax.device_get(_settled(machine, self.names, rows, start, settle))

            self.before = self.before or _affordable_cycles(found)
            self._kept = (parameter, key), Diagram(control.label, across, *found(self.before))
        return self._kept[1]

    def words(self, motion: Motion) -> dict[str, str]:
        """Return the texts above the picture of a motion, by name."""
        units, (low, high) = self.machine.units, motion.extremes
        found = {"position": f"{low:.5g} … {high:.5g}"}
        found |= {name: f"{x:.5g}" for name, x in motion.quantities.items()}
        return {name: with_unit(x, unit_of(units, name)) for name, x in found.items()}


# Ranges of the sliders of the paper's scene with either drive, and with one of them.
_SCENE = {"stops.0.gap": (0.0, 5.0), "damping_ratio": (0.0, 0.2),
          "start.Y": (-5.0, 5.0), "start.V": (-5.0, 5.0)}  # fmt: skip
_IDEAL = {"drive.frequency_ratio": (0.3, 2.5), **_SCENE}
_MOTOR = {"drive.control": (0.3, 2.5), "start.W": (0.1, 2.5), **_SCENE}


def ready() -> dict[str, Callable[[], Subject]]:
    """Return the machines of the menu: the paper's scene, and ready machines with all defaults."""
    ideal, motor = Scene.ideal(frequency_ratio=0.9, damping_ratio=0.01), Parameters().scene()
    found: dict[str, Callable[[], Subject]] = {
        "Scene, ideal drive": lambda: Subject(ideal, _IDEAL),
        "Scene, motor": lambda: Subject(motor, _MOTOR),
    }
    for name in sorted(machines.READY):
        make = getattr(machines, name)
        parameters = inspect.signature(make).parameters.values()
        if all(part.default is not part.empty for part in parameters):
            found[name] = lambda make=make: Subject(make())
    return found


def _label(machine: AbstractMachine, name: str, numbers: Mapping[str, Any]) -> str:
    """Return the field's symbol of a number, or its name if another number has the same symbol."""
    if name.startswith(START):
        return f"start {axis_name(name.removeprefix(START), machine.units)}"
    label = axis_name(name, machine.units)
    alone = sum(axis_name(other, machine.units) == label for other in numbers) == 1
    return label if alone else in_brackets(name, unit_of(machine.units, name))


def _range_of(machine: object, name: str, value: float) -> tuple[float, float]:
    """Return the range from zero to twice the value (-1 to 1 for zero), as far as allowed."""
    low, high = sorted((0.0, 2 * value)) if value else (-1.0, 1.0)
    if name.startswith(START):
        reach = max(2 * abs(value), 2.0)
        return -reach, reach
    part: Any = machine
    *path, last = name.partition("[")[0].split(".")
    for word in path:
        part = part[int(word)] if word.isdigit() else getattr(part, word, None)
    legal = fields_with(type(part), "range").get(last)
    if legal is None:
        return low, high
    if np.isfinite(legal.low) and np.isfinite(legal.high):
        low, high = legal.low, legal.high
    low, high = max(low, legal.low), min(high, legal.high)
    margin = (high - low) / _STEPS
    return low + margin * (low == legal.low and legal.open_low), high - margin * (
        high == legal.high and legal.open_high
    )


def _grid(low: float, high: float, value: float) -> tuple[float, float]:
    """Return the first value of a slider and its step: 1, 2 or 5 times a power of ten, if the value
    is a multiple of that. The value is on the grid: otherwise the page would move it."""
    rough = (high - low) / _STEPS
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(power * max(digit for digit in (1, 2, 5) if digit * power <= 1.001 * rough))
    if abs(value / step - round(value / step)) < 1e-9:
        first = value - int((value - low) / step + 1e-9) * step
        return (0.0 if abs(first) < 1e-9 * step else float(f"{first:.12g}")), step
    if not low < value < high:
        return low, rough
    return low, (value - low) / max(1, round((value - low) / rough))


def _affordable_cycles(do: Callable[[int], Any]) -> int:
    """Return the number of cycles that can be computed in the time for a redrawing."""
    # Processor time, which other programs do not delay.
    options: Any = {"timer": time.process_time, "number": 1, "repeat": 2}
    seconds = lambda cycles: min(timeit.repeat(lambda: do(cycles), **options))
    do(0)  # compiles
    if (overhead := seconds(0)) > _PATIENCE:
        return _FEWEST
    each = max((seconds(_TRIED) - overhead) / _TRIED, 1e-9)
    return int(np.clip((_PATIENCE - overhead) / each, _FEWEST, _LONGEST)) // 10 * 10


@compiled
def _settled(machine: Any, names: tuple[str, ...], rows: Any, start: Any, settle: Any) -> Any:
    def one(row):
        current = with_leaves(machine, dict(zip(names, row, strict=True)))
        run = simulate(
            current, moved_by_stops(current, convert_start(current, start)), CYCLES, settle=settle
        )
        assert run.y_min is not None and run.impact_speed is not None
        Y, V = (jax.vmap(f)(run.sections)[1:] for f in (current.position, current.velocity))
        return Y, V, run.y_min, run.impact_speed

    return jax.vmap(one)(rows)
