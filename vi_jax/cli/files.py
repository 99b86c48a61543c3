"""TOML files for the command line."""

import inspect
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..machine import AbstractMachine, State, check_name, leaf_names, with_leaf
from ..machines.named import InputError, check_keys


def read(path: str) -> dict[str, Any]:
    """Return the tables of a file. **Raises:** `InputError`."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))  # some editors' mark
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


@contextmanager
def errors_in(place: str) -> Iterator[None]:
    """Turn errors of the library about its arguments into a `InputError` that names the table."""
    try:
        yield
    except (ValueError, TypeError) as error:
        if isinstance(error, InputError) or not re.match(
            "Argument|Axis|Method|Measure", str(error)
        ):
            raise
        raise InputError(f"{place}: {error}") from None


def start_of(machine: AbstractMachine, table: Any) -> Any:
    """Return the state that `[start]` describes. **Raises:** `InputError`.

    Its keys are the arguments of the machine's `start`, if that has any; else components of the
    state, which replace those of the default start. Without a `start` they are the whole state.
    """
    if not isinstance(table, dict):
        return table
    if type(machine).start is AbstractMachine.start:
        return State(**table)
    parameters = inspect.signature(machine.start).parameters
    with errors_in("[start]"):
        if parameters:
            if not any(x.kind is x.VAR_KEYWORD for x in parameters.values()):
                check_keys(table, parameters, "[start]")
            return machine.start(**table)
        state = machine.start()
        for name, number in table.items():
            state = with_leaf(state, check_name(leaf_names(state), name, "start"), number)
        return state
