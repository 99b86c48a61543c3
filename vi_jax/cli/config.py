"""Files for the command line: a machine, how it moves and what is asked of it, as TOML.

    [scene]                         # the paper's machine without dimensions
    frequency_ratio = 0.9           # drive = "motor" takes [scene.motor], the keys of `Motor`,
                                    # or of `DCMotor` with its electrical_time
    restitution = 0.5
    gap = 2.0                       # or [[scene.stops]] with side, gap, restitution; and
                                    # [[scene.soft_stops]], the arguments of `SoftStop`
    crank = "slider"                # with crank_ratio; "cosine" by default

    [parameters]                    # instead: the same in SI units, the keys of `Parameters`

    [machine]                       # instead: a machine of `vi_jax.machines`
    name = "ImpactPair"
    numbers = { half_gap = 2.0 }    # its arguments

    [start]                         # Y, V and, for a motor, W (and M), or what the machine's start
                                    # takes; at rest if left out
    [method]                        # name = "draft", "standard", "reference", or "exact-flight",
                                    # "adaptive", "fixed-step", "taylor" with their arguments
    [axes]                          # for scan: rows of values, as lists or as below
    "stops.0.restitution" = { from = 0.1, to = 0.9, count = 64 }

and one table for each verb: `[scan]`, `[sweep]`, `[basins]`, `[orbit]`, `[simulate]`. Their keys
are the arguments of that function, and the files to write; what is left out is as in Python.
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import diffrax
from attrs import field, frozen

from ..flow import AbstractMethod, Adaptive, ExactFlight, FixedStep, Taylor, Verner9
from ..machine import AbstractMachine
from ..orbit import AbstractRootFinder, Gradient, Newton
from .machine import (
    MachineTable,
    ParametersTable,
    SceneTable,
    machine_named,
    outdated,
    start_of,
)  # fmt: skip
from .toml import ConfigError as ConfigError
from .toml import Row, given, in_terms_of, read_toml, unknown

_METHODS = {
    "exact-flight": ExactFlight, "adaptive": Adaptive, "fixed-step": FixedStep, "taylor": Taylor,
}  # fmt: skip
_SOLVERS = {
    name: kind
    for name, kind in vars(diffrax).items()
    if isinstance(kind, type)
    and issubclass(kind, diffrax.AbstractERK | diffrax.AbstractESDIRK)
    and name[:8] != "Abstract"
} | {"Verner9": Verner9}


@frozen(kw_only=True)
class MethodTable:
    """`[method]`: what moves the machine."""

    name: Literal[
        "draft", "standard", "reference", "exact-flight", "adaptive", "fixed-step", "taylor"
    ]
    solver: str | None = None
    order: int | None = None
    rtol: float | None = None
    atol: float | None = None
    steps_per_cycle: int | None = None

    def build(self) -> AbstractMethod | str:
        """The method, or the name of a preset."""
        kind, options = _METHODS.get(self.name), given(self, "name")
        known = {field.name for field in dataclasses.fields(kind)} if kind else set()
        for key in options.keys() - known:
            raise ConfigError(f'`{key}` in [method] does not belong to name = "{self.name}"')
        if kind is None:
            return self.name
        if self.solver is not None:
            if self.solver not in _SOLVERS:
                raise ConfigError(unknown("solver", self.solver, "[method]", _SOLVERS))
            options["solver"] = _SOLVERS[self.solver]()
        with in_terms_of("[method]"):
            return kind(**options)


@frozen(kw_only=True)
class _Grid:
    """What every verb that runs many lanes takes."""

    settle: int | None = None
    max_impacts: int | None = None
    max_steps: int | None = None
    lanes: int | None = None
    workers: int | None = None
    store: str | None = None
    picture: str | None = None


@frozen(kw_only=True)
class ScanTable(_Grid):
    """`[scan]`."""

    measure: tuple[str, ...] | None = None
    cycles: int | None = None
    derivatives: tuple[str, ...] | None = None
    paired: bool = False
    verify: int | None = None


@frozen(kw_only=True)
class BasinsTable(_Grid):
    """`[basins]`."""

    region: dict[str, tuple[float, float]]
    resolution: tuple[int, ...] | None = None
    samples: int | None = None
    seed: int | None = None
    longest: int | None = None
    tolerance: float | None = None
    apart: float | None = None
    output: str | None = None


@frozen(kw_only=True)
class SweepTable:
    """`[sweep]`."""

    parameter: str
    values: Row
    settle: int | None = None
    cycles: int | None = None
    tolerance: float | None = None
    max_steps: int | None = None
    up_and_down: bool = False
    y: str | None = None
    picture: str | None = None
    output: str | None = None


@frozen(kw_only=True)
class ContinueTable:
    """`[orbit.continue]`."""

    parameter: str
    bounds: tuple[float, float]
    step: float | None = None
    max_step: float | None = None
    max_points: int | None = None
    y: str | None = None
    picture: str | None = None
    output: str | None = None


@frozen(kw_only=True)
class OrbitTable:
    """`[orbit]`."""

    cycles: int = 1
    guess: dict[str, float] | None = None
    root_finder: Literal["newton", "gradient"] = "newton"
    tolerance: float | None = None
    max_steps: int | None = None
    arcs: int | None = None
    picture: str | None = None
    continue_: ContinueTable | None = None

    def search(self) -> AbstractRootFinder:
        """The search for the motion."""
        options = given(self, "cycles", "guess", "root_finder", "picture", "continue_")
        with in_terms_of("[orbit]"):
            return (Newton if self.root_finder == "newton" else Gradient)(**options)


@frozen(kw_only=True)
class SimulateTable:
    """`[simulate]`."""

    cycles: int
    settle: int | None = None
    samples: int | None = None
    max_impacts: int | None = None
    max_steps: int | None = None
    picture: str | None = None
    output: str | None = None


@frozen(kw_only=True)
class Config:
    """A whole file: a machine, how it moves, and a table for each verb."""

    scene: SceneTable | None = None
    parameters: ParametersTable | None = None
    machine: MachineTable | None = None
    start: dict[str, float] | None = None
    method: MethodTable | None = None
    axes: dict[str, Row] | None = None
    scan: ScanTable | None = None
    sweep: SweepTable | None = None
    basins: BasinsTable | None = None
    orbit: OrbitTable | None = None
    simulate: SimulateTable | None = None

    own: AbstractMachine | None = field(init=False, default=None)
    """A machine that the command line names, not the file."""

    def build(self) -> tuple[AbstractMachine, Any, AbstractMethod | str | None]:
        """Machine, start and method; `None` for what the file leaves out."""
        tables = {name: getattr(self, name) for name in ("scene", "parameters", "machine")}
        tables = {f"[{name}]": table for name, table in tables.items() if table is not None}
        held = " and ".join(tables) or "none of them"
        if self.own is not None and tables:
            raise ConfigError(
                f"the file must not describe a machine beside --machine, but has {held}"
            )
        if self.own is None and len(tables) != 1:
            raise ConfigError(
                f"the file must hold [scene], [parameters] or [machine], but holds {held}"
            )
        machine = self.own or next(iter(tables.values())).build()
        start = None if self.start is None else start_of(machine, self.start, "[start]")
        return machine, start, self.method and self.method.build()


def read(path: str | Path, *, machine: str | None = None) -> Config:
    """Read a file; with `machine`, a name `package.module:function`, for the machine that this
    function returns. **Raises:** `ConfigError` that names every fault with its place."""
    config = read_toml(path, Config, outdated)
    if machine is not None:
        object.__setattr__(config, "own", machine_named(machine))
    return config
