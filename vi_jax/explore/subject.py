"""Any machine on the page: sliders made of its numbers, and the machine at other values of them."""

import inspect
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import machines
from .._checks import interval
from .._programs import compiled
from ..flow import simulate
from ..machine import (
    AbstractMachine,
    check_again,
    components,
    unit_of,
    with_leaf,
    with_unit,
)
from ..scans import taken_along
from .controls import Control
from .diagram import CYCLES, Diagram
from .motion import Motion, look, prepare

START, SETTLE = "start.", "cycles before"
"""How the sliders of the start are named, and that of the cycles before what is drawn."""

ACROSS = 121
"""Values across a diagram."""

# Steps of a slider; sliders at most that are made by themselves; seconds within which a redrawing
# computes, which with drawing is below 0.2; cycles before what is drawn at most. Choices.
_STEPS, _MOST, _PATIENCE, _LONGEST = 400, 40, 0.08, 1000

# Numbers that cycles before are tried with, to learn what one takes; and the fewest. Choices.
_TRIED, _FEWEST = 40, 20


class Subject:
    """A machine whose numbers are sliders.

    **Arguments:** the machine; ranges of some of its numbers and of its start (`"start.Y"`), which
    go before those of its own `slider_ranges`, if it has such, and before those made here: from
    zero to twice the value, within what the machine allows.

    **Raises:** `ValueError` for a range of what it does not have, or that is none.
    """

    def __init__(
        self, machine: AbstractMachine, ranges: Mapping[str, tuple[float, float]] | None = None
    ):
        self.machine, self.start = machine, machine.adopt(machine.start())
        given = {**getattr(machine, "slider_ranges", {}), **(ranges or {})}
        numbers = {name: x for name, x in components(machine).items() if _is_real(x)}
        numbers = {name: float(x) for name, x in numbers.items()}
        begin = {f"{START}{name}": float(x) for name, x in components(self.start).items()}
        for name in given:
            if name not in numbers and name not in begin:
                known = ", ".join([*numbers, *begin])
                raise ValueError(f"A range must be of a number of the machine ({known}), "
                                 f"but is of {name!r}.")  # fmt: skip
        asked = [name for name in numbers if name in given]
        shown = [*asked, *(name for name in numbers if name not in given)][:_MOST]
        self.names = tuple(name for name in numbers if name in shown)
        """Of the machine's numbers that have sliders."""
        self.controls: dict[str, Control] = {}
        for name, value in {**{x: numbers[x] for x in self.names}, **begin}.items():
            low, high = _range_of(machine, name, value)
            if name in given:
                low, high = interval(f"ranges[{name!r}]", given[name])
            low, high = min(low, value), max(high, value)
            unit = unit_of(machine.units, name.removeprefix(START))
            label = f"{name} ({unit})" if unit not in ("", "1") else name
            self.controls[name] = Control(label, low, high, _step_of(low, high, value), value)
        self.controls[SETTLE] = Control(SETTLE, 0.0, _LONGEST, 1.0, 0.0)
        self.before = _FEWEST
        """Cycles before what a diagram shows."""

    def at(self, values: Mapping[str, Any]) -> tuple[AbstractMachine, Any]:
        """Machine and start at these places of the sliders.

        **Raises:** `ValueError` for numbers that the machine refuses.
        """
        machine, start = self.machine, self.start
        for name in self.names:
            if values[name] != self.controls[name].value:
                machine = with_leaf(machine, name, float(values[name]))
        check_again(machine)
        for name in components(start):
            start = with_leaf(start, name, float(values[START + name]))
        return machine, start

    def seen(self, values: Mapping[str, Any]) -> Motion:
        """The motion at these places of the sliders."""
        return look(*self.at(values), int(values[SETTLE]))

    def compile(self, tell: Callable[[str], None]) -> None:
        """Compile what the sliders need, and fit the cycles before to how long they take here."""
        name = type(self.machine).__name__
        tell(f"compiling the {name}")
        start = self.at(self.beginning())[1]
        prepare(self.machine, start)
        fits = _fitting(lambda cycles: look(self.machine, start, cycles))
        self.controls[SETTLE] = Control(SETTLE, 0.0, float(fits), 1.0, float(min(300, fits)))
        if self.names:
            tell(f"compiling the diagram of the {name}")
            values, one = self.beginning(), self.names[0]
            self.diagram(values, one)

            def timed(cycles: int) -> None:
                self.before = cycles
                self.diagram(values, one)

            self.before = _fitting(timed)

    def beginning(self) -> dict[str, float]:
        """The first value of each slider, by name."""
        return {name: control.value for name, control in self.controls.items()}

    def diagram(self, values: Mapping[str, Any], parameter: str) -> Diagram:
        """What motions from the start settle on over one of the machine's numbers."""
        machine, start = self.at(values)
        control = self.controls[parameter]
        across = np.linspace(control.low, control.high, ACROSS)
        rows = np.tile([float(values[name]) for name in self.names], (ACROSS, 1))
        rows[:, self.names.index(parameter)] = across
        found = _settled(
            machine, self.names, jnp.asarray(rows), start, jnp.asarray(float(self.before))
        )
        return Diagram(parameter, across, *map(np.asarray, found))

    def words(self, motion: Motion) -> dict[str, str]:
        """What stands beside the picture of a motion, by name."""
        units, (low, high) = self.machine.units, motion.extremes
        found = {"position": f"{low:.5g} … {high:.5g}"}
        found = {name: with_unit(x, unit_of(units, name)) for name, x in found.items()}
        for name, x in motion.quantities.items():
            found[name] = with_unit(f"{x:.5g}", unit_of(units, name))
        return found

    @staticmethod
    def stops(machine: AbstractMachine) -> np.ndarray:
        """The places of the stops that limit what pictures show; NaN where there are none."""
        places = [float(stop.place) for stop in machine.stops if stop.coordinate == 0]
        return np.array(places or [np.nan])


def ready() -> dict[str, type[AbstractMachine]]:
    """The ready machines that can be made without numbers, by their names."""
    kinds = {name: x for name, x in vars(machines).items() if inspect.isclass(x)}
    return {
        name: kind
        for name, kind in sorted(kinds.items())
        if issubclass(kind, AbstractMachine)
        and all(p.default is not p.empty for p in inspect.signature(kind).parameters.values())
    }


def _is_real(x: object) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _range_of(machine: object, name: str, value: float) -> tuple[float, float]:
    """From zero to twice the value (-1 to 1 of zero), within what the machine allows."""
    low, high = sorted((0.0, 2 * value)) if value else (-1.0, 1.0)
    if name.startswith(START):
        reach = max(2 * abs(value), 2.0)
        return -reach, reach
    part: Any = machine
    *path, last = name.partition("[")[0].split(".")
    for word in path:
        part = part[int(word)] if word.isdigit() else getattr(part, word, None)
    legal = getattr(part, "ranges", {}).get(last)
    if legal is None:
        return low, high
    if np.isfinite(legal.low) and np.isfinite(legal.high):
        low, high = legal.low, legal.high
    low, high = max(low, legal.low), min(high, legal.high)
    margin = (high - low) / _STEPS
    return low + margin * (low == legal.low and legal.open_low), high - margin * (
        high == legal.high and legal.open_high
    )


def _step_of(low: float, high: float, value: float) -> float:
    """The step of a slider: one of its places is the value, to which the page would move it."""
    if not low < value < high:
        return (high - low) / _STEPS
    return (value - low) / max(1, round(_STEPS * (value - low) / (high - low)))


def _fitting(do: Callable[[int], Any]) -> int:
    """How many cycles before are done in the time that a redrawing may take."""
    took = []
    for cycles in (0, _TRIED):
        do(cycles)
        since = time.perf_counter()
        do(cycles)
        took.append(time.perf_counter() - since)
    each = max((took[1] - took[0]) / _TRIED, 1e-9)
    return int(np.clip((_PATIENCE - took[0]) / each, _FEWEST, _LONGEST)) // 10 * 10


@compiled
def _settled(machine: Any, names: tuple[str, ...], rows: Any, start: Any, settle: Any) -> Any:
    def one(row):
        here = machine
        for i, name in enumerate(names):
            here = with_leaf(here, name, row[i])
        run = simulate(here, taken_along(here, here.adopt(start)), CYCLES, settle=settle)
        assert run.y_min is not None and run.impact_speed is not None
        Y, V = (jax.vmap(f)(run.sections)[1:] for f in (here.position, here.velocity))
        return Y, V, run.y_min, run.impact_speed

    return jax.vmap(one)(rows)
