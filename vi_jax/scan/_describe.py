"""What a scan is, in words and numbers: by it a store knows its own scan, and data their origin."""

import hashlib
import json
import re
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._version import installed_version
from ..machine.numbers import leaf, leaf_names
from ._identity import Unverifiable, identity
from .grid import Blocks
from .measures import Regime
from .program import ScanProgram
from .regime import CODES
from .store import UNVERIFIABLE


def description_of(job: ScanProgram, blocks: Blocks) -> dict[str, Any]:
    """What makes two scans the same, in words and numbers that JSON can hold."""

    def described(tree: Any) -> str:
        return _lasting(eqx.tree_pformat(tree, short_arrays=False, width=10**6))

    machine: dict[str, Any]
    if job.machine is not None:
        machine = {name: _described(leaf(job.machine, name)) for name in leaf_names(job.machine)}
        machine["structure"] = _lasting(str(jtu.tree_structure(job.machine)))
    else:  # a function is known by what it makes
        machine = {"made by": _lasting(getattr(job.build, "__qualname__", repr(job.build)))}
        for name, place in (("first", 0), ("last", -1)):
            made, _ = job.lane(_lane(blocks, place))
            machine |= {
                f"{name} {leaf_}": _described(leaf(made, leaf_)) for leaf_ in leaf_names(made)
            }
            machine[f"{name} structure"] = _lasting(str(jtu.tree_structure(made)))
    start: Any = "the machine's own"
    if job.start is not None:
        start = {name: _described(leaf(job.start, name)) for name in leaf_names(job.start)}
    about: dict[str, Any] = {
        "machine": machine,
        "start": start,
        "paired": blocks.paired,
        "axis": {
            name: {
                "values": x.size,
                "from": float(x[0]),
                "to": float(x[-1]),
                "digest": hashlib.sha256(x.tobytes()).hexdigest()[:16],
            }
            for name, x in blocks.axes.items()
        },
        "measure": [described(m) for m in job.measures],
        "method": described(job.method),
        "clock": job.clock,
        "settle": int(job.settle),
        "cycles": job.cycles,
        "derivatives": list(job.derivatives),
        "max_impacts": job.max_impacts,
        "max_steps": job.max_steps,
        "lanes": blocks.lanes,
        "precision": str(jnp.result_type(float)),
        "code of": _codes(job),
    }
    if any(isinstance(measure, Regime) for measure in job.measures):
        # A store of an earlier release has other numbers for them, not to be mixed with these.
        about["regimes"] = dict(CODES)
    return about


def _lasting(text: str) -> str:
    """Without addresses in memory, which are others in each process."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _lane(blocks: Blocks, place: int) -> dict[str, Any]:
    return {name: jnp.asarray(x[place]) for name, x in blocks.axes.items()}


def _codes(job: ScanProgram) -> dict[str, str]:
    """What tells the user's own functions and classes from others of the same name."""
    parts: dict[str, Any] = {"machine": job.machine if job.build is None else job.build}
    parts |= {"start": job.start, "method": job.method}
    for i, measure in enumerate(job.measures):
        parts[f"measure {i + 1}"] = measure
    found = {}
    for name, part in parts.items():
        try:
            found[name] = identity(part)
        except Unverifiable as error:
            found[name] = f"{UNVERIFIABLE}{error}"
    return found


def _described(x: Any) -> Any:
    return np.asarray(x, float).tolist()


def attributes_of(about: dict[str, Any]) -> dict[str, Any]:
    """The attributes of a scan's data, from its description."""
    return {
        "vi_jax": installed_version(),
        "method": about["method"],
        "settle": about["settle"],
        "cycles": about["cycles"],
        "machine": json.dumps(about["machine"]),
        "start": json.dumps(about["start"]),
        "precision": about["precision"],
    }
