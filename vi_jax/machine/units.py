"""Units of a machine's quantities, and the words of labels."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from .._types import Machine

NONE: Mapping[str, str] = MappingProxyType({})


Stated = tuple[tuple[str, str], ...]
"""The units of a machine as pairs of names and units, comparable and therefore static."""


PLAIN = "position", "velocity"
"""The labels of a machine without others."""


def unit_of(units: Mapping[str, str], name: str) -> str:
    """Return the unit of a quantity or a number, also by its last word; "" if unknown."""
    last = name.split(".")[-1].split("[")[0]
    for key in (name, "" if name.startswith("v.") else last, ""):  # `v.x` and `x` differ
        if key in units:
            return units[key]
    return ""


def units_of(machine: Machine) -> dict[str, str]:
    """Return the units of a machine. By default, position and velocity have those of the components
    that are their labels."""
    units = dict(machine.units)
    for quantity, name in zip(PLAIN, machine.labels, strict=True):
        if name in units:
            units.setdefault(quantity, units[name])
    return units


def stated(machine: Machine) -> Stated:
    """Return the units of a machine as pairs."""
    return tuple(units_of(machine).items())


def attributes(unit: str) -> dict[str, str]:
    """Return the attribute of a variable in this unit; empty for an unknown unit."""
    return {"units": unit} if unit else {}


def in_unit(text: str, units: Mapping[str, str], name: str) -> str:
    """Return a number with the unit of this name, if it has one."""
    return with_unit(text, unit_of(units, name))


def with_unit(text: str, unit: str) -> str:
    """Return a number with its unit, if it has one."""
    return text if unit in ("", "1") else f"{text} {unit}"


QUANTITIES = {
    "y_min": "position", "y_max": "position", "clearance": "position",
    "impact_speed": "velocity", "log_speed": "velocity", "frequency_ratio": "frequency_ratio",
    "exponents": "rate", "spread": "rate", "impact_energy": "energy", "duration": "time",
    "log_phase": "phase", "impact_phase": "phase", "event_phase": "phase",
    "outcome_phase": "phase",
    "fastest_impact": "velocity", "slowest_impact": "velocity",
}  # fmt: skip
"""The quantities that the arrays of results contain."""


_PREFIXES = ("error_section_", "section_", "sample_", "error_", "start.")


def quantity_of(name: str) -> str | None:
    """Return the quantity or the component of a state in a variable of a data set, or `None`."""
    for prefix in _PREFIXES:
        if name.startswith(prefix):
            inner = name.removeprefix(prefix)
            return QUANTITIES.get(inner, inner)
    return QUANTITIES.get(name)


def with_units(data: Any, units: Mapping[str, str], named: Mapping[str, str] = NONE) -> Any:
    """Return a data set with units as attributes; `named` has names of numbers by variables."""
    for name in data.variables:
        quantity = named.get(name) or quantity_of(str(name))
        if quantity is not None:
            data[name].attrs |= attributes(unit_of(units, quantity))
    return data


def in_brackets(words: str, unit: str) -> str:
    """Return the label of an axis with its unit, if it has one."""
    return words if unit in ("", "1") else f"{words} ({unit})"


def drive_speed(units: Mapping[str, str]) -> str:
    """Return the name of the mean speed of a drive. In units of ω it is the frequency ratio ζ."""
    return "ζ" if unit_of(units, "frequency_ratio") == "ω" else "speed of the drive"


def unit_in(label: str) -> str:
    """Return the unit at the end of a label such as "height (g/ω²)"."""
    return label.partition(" (")[2].removesuffix(")")


def name_in(label: str) -> str:
    """Return the name at the beginning of a label such as "height (g/ω²)" or "Y = y/a"."""
    return label.partition(" (")[0].partition(" = ")[0]
