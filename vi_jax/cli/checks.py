"""What a file must hold beyond its form, checked before anything is simulated."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from .._checks import unwritable
from .._types import State
from ..machine import AbstractMachine, leaf, leaf_names
from ..orbit import check_walk, column_names
from ..plot import ENDINGS
from ..scans import Blocks, axes_of, check_corners, make_program
from .config import ContinueTable
from .toml import ConfigError, given, in_terms_of, unknown


def check_names(
    machine: AbstractMachine, names: Iterable[str], place: str, *, start: bool = False
) -> None:
    """**Raises:** `ConfigError` for a name that no number of the machine (or the start) has."""
    known = leaf_names(machine)
    if start:
        known += [f"start.{name}" for name in leaf_names(machine.start())]
    wrong = [unknown("name", name, place, known) for name in names if name not in known]
    if wrong:
        raise ConfigError(*wrong)


def check_range(machine: AbstractMachine, name: str, values: Sequence[float], place: str) -> None:
    """**Raises:** `ConfigError` if the machine refuses the least or greatest of these values."""
    with in_terms_of(place, keys=()):
        axes = axes_of({name: values})
        check_corners(make_program(machine, (name,), measure="extremes"), Blocks(axes, 1))


def check_paths(table: str, *, picture: str | None = None, output: str | None = None) -> None:
    """**Raises:** `ConfigError` if a file cannot be written; makes the folders above them."""
    for key, path, endings in (("picture", picture, ENDINGS), ("output", output, (".csv",))):
        if path is None:
            continue
        if Path(path).suffix.lower() not in endings:
            allowed = ", ".join(endings)
            raise ConfigError(f'`{key}` in {table} must end in {allowed}, but is "{path}"')
        reason = unwritable(Path(path).parent)
        try:
            if reason is None and Path(path).is_dir():
                reason = "it is a folder"
            elif reason is None and Path(path).exists() and not os.access(path, os.W_OK):
                reason = "permission denied"
        except OSError as error:  # a name that is too long
            reason = error.strerror
        if reason:
            raise ConfigError(f"`{key}` in {table} cannot be written: {path}: {reason}")


def check_quantity(name: str | None, place: str, known: Iterable[str]) -> None:
    """**Raises:** `ConfigError` if a picture is asked for something that there is not."""
    known = tuple(known)
    if name is not None and name not in known:
        raise ConfigError(f"{unknown('quantity', name, place, known)}; all: {', '.join(known)}")


def check_map(axes: Mapping[str, Any], measure: Iterable[str] | None, *, paired: bool) -> None:
    """**Raises:** `ConfigError` if a scan cannot be drawn as a map of regimes."""
    if measure is not None and "regime" not in measure:
        raise ConfigError('`picture` in [scan] needs "regime" among the measures')
    if len(axes) != 2 or paired:
        raise ConfigError(
            f"`picture` in [scan] needs a grid of two axes, but there are {len(axes)}"
        )


def check_continuation(machine: AbstractMachine, start: State, asked: ContinueTable) -> None:
    """**Raises:** `ConfigError` if the branch cannot begin, or its files not be written."""
    check_names(machine, [asked.parameter], "[orbit.continue]")
    low, high = asked.bounds
    value = float(leaf(machine, asked.parameter))
    if not low <= value <= high or low == high:
        raise ConfigError(
            f"`bounds` in [orbit.continue] must hold the machine's {asked.parameter} = {value:g}, "
            f"but is [{low:g}, {high:g}]"
        )
    check_range(machine, asked.parameter, asked.bounds, "`bounds` in [orbit.continue]")
    walk = {"step": 0.01, "max_step": 0.1, "max_points": 1000}
    with in_terms_of("[orbit.continue]"):
        check_walk(**{name: given(asked).get(name, usual) for name, usual in walk.items()})
    check_quantity(asked.y, "`y` in [orbit.continue]", column_names(machine, start))
    check_paths("[orbit.continue]", picture=asked.picture, output=asked.output)
