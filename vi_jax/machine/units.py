"""In which units a machine's quantities are, as it states them itself."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from .._types import Machine

NONE: Mapping[str, str] = MappingProxyType({})

Stated = tuple[tuple[str, str], ...]
"""What a machine states, as pairs of names and units: it can be compared, and so be static."""


PLAIN = "position", "velocity"
"""What a machine calls them that has no other words."""


def unit_of(units: Mapping[str, str], name: str) -> str:
    """The unit of a quantity, of a number by its last word too; "" where none is stated."""
    last = name.split(".")[-1].split("[")[0]
    for key in (name, "" if name.startswith("v.") else last, ""):  # `v.x` has another one than `x`
        if key in units:
            return units[key]
    return ""


def units_of(machine: Machine) -> dict[str, str]:
    """The units that a machine states. Those of position and velocity are by default those of the
    numbers in the state that they are."""
    units = dict(machine.units)
    for quantity, name in zip(PLAIN, machine.labels, strict=True):
        if name in units:
            units.setdefault(quantity, units[name])
    return units


def stated(machine: Machine) -> Stated:
    """The units of a machine."""
    return tuple(units_of(machine).items())


def attributes(unit: str) -> dict[str, str]:
    """The attribute of a variable in this unit; none where it is not known."""
    return {"units": unit} if unit else {}


def in_unit(text: str, units: Mapping[str, str], name: str) -> str:
    """A number of this name with its unit, if it has one."""
    return with_unit(text, unit_of(units, name))


def with_unit(text: str, unit: str) -> str:
    """A number with its unit, if it has one."""
    return text if unit in ("", "1") else f"{text} {unit}"


QUANTITIES = {
    "y_min": "position", "y_max": "position", "clearance": "position",
    "impact_speed": "velocity", "log_speed": "velocity", "frequency_ratio": "frequency_ratio",
    "exponents": "rate", "spread": "rate", "impact_energy": "energy", "duration": "time",
    "log_phase": "phase", "impact_phase": "phase", "event_phase": "phase",
    "fastest_impact": "velocity", "slowest_impact": "velocity",
}  # fmt: skip
"""What the arrays of results are of."""

_PREFIXES = ("error_section_", "section_", "sample_", "error_", "start.")


def quantity_of(name: str) -> str | None:
    """What a variable of a data set is of: a quantity, a component of a state, or neither."""
    for prefix in _PREFIXES:
        if name.startswith(prefix):
            inner = name.removeprefix(prefix)
            return QUANTITIES.get(inner, inner)
    return QUANTITIES.get(name)


def with_units(data: Any, units: Mapping[str, str], named: Mapping[str, str] = NONE) -> Any:
    """A data set whose variables say in which units they are; `named` are numbers of a machine by
    other names than their own."""
    for name in data.variables:
        quantity = named.get(name) or quantity_of(str(name))
        if quantity is not None:
            data[name].attrs |= attributes(unit_of(units, quantity))
    return data


def in_brackets(words: str, unit: str) -> str:
    """The name of an axis with its unit, if it has one."""
    return words if unit in ("", "1") else f"{words} ({unit})"


def unit_in(label: str) -> str:
    """The unit at the end of a label such as "height (g/ω²)"."""
    return label.partition(" (")[2].removesuffix(")")


def name_in(label: str) -> str:
    """The name at the beginning of a label such as "height (g/ω²)" or "Y = y/a"."""
    return label.partition(" (")[0].partition(" = ")[0]
