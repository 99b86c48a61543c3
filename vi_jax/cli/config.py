"""Files for the command line: a scene, how it moves and what is asked of it, as TOML.

    [scene]                         # dimensionless; or [machine], the keys of `Parameters` in SI
    frequency_ratio = 0.9           # drive = "motor" takes [scene.motor], the keys of `Motor`,
                                    # or of `DCMotor` with its electrical_time
    restitution = 0.5
    gap = 2.0                       # or [[scene.stops]] with side, gap, restitution; and
                                    # [[scene.soft_stops]], the arguments of `SoftStop`
    crank = "slider"                # with crank_ratio; "cosine" by default

    [model]                         # instead: a machine of `vi_jax.machines`
    name = "ImpactPair"
    numbers = { half_gap = 2.0 }    # its arguments

    [start]                         # Y, V and, for a motor, W (and M), or what the model's start
                                    # takes; at rest if left out
    [method]                        # name = "draft", "standard", "reference", or "exact-flight",
                                    # "adaptive", "fixed-step" with solver, rtol, …
    [axes]                          # for scan: rows of values, as lists or as below
    "stops.0.restitution" = { from = 0.1, to = 0.9, count = 64 }

and one table for each verb: `[scan]`, `[sweep]`, `[basins]`, `[orbit]`, `[simulate]`. Their keys
are the arguments of that function, and the files to write; what is left out is as in Python.
"""

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import diffrax
from attrs import field, frozen

from .. import machines
from ..flow import AbstractMethod, Adaptive, ExactFlight, FixedStep
from ..orbit import AbstractSearch, Gradient, Newton
from ..scene import (
    AbstractScene,
    DCMotor,
    IdealDrive,
    Motor,
    Oscillator,
    Parameters,
    RigidStop,
    Scene,
    SliderCrank,
    SoftStop,
)
from .toml import ConfigError as ConfigError
from .toml import Row, given, in_terms_of, read_toml, unknown

_METHODS = {"exact-flight": ExactFlight, "adaptive": Adaptive, "fixed-step": FixedStep}
_SOLVERS = {
    name: kind
    for name, kind in vars(diffrax).items()
    if isinstance(kind, type) and issubclass(kind, diffrax.AbstractERK) and name[:8] != "Abstract"
}


@frozen(kw_only=True)
class MachineTable:
    """`[machine]`: the numbers of `Parameters` in SI units."""

    drive: Literal["motor", "ideal"] = "motor"
    crank: Literal["cosine", "slider"] = "cosine"
    clock: Literal["phase", "time"] = "phase"
    body_mass: float | None = None
    slider_mass: float | None = None
    stiffness: float | None = None
    damping: float | None = None
    crank_radius: float | None = None
    rod_length: float | None = None
    inertia: float | None = None
    restitution: float | None = None
    gap: float | None = None
    torque: float | None = None
    control: float | None = None
    no_load_speed: float | None = None
    electrical_time: float | None = None

    def build(self) -> Scene:
        """The dimensionless scene."""
        with in_terms_of("[machine]"):
            table = Parameters(**given(self, "drive", "crank", "clock"))
            return table.scene(drive=self.drive, crank=self.crank).in_clock(self.clock)


@frozen(kw_only=True)
class StopTable:
    """One `[[scene.stops]]`."""

    gap: float
    restitution: float | None = None
    side: Literal["right", "left"] = "right"


@frozen(kw_only=True)
class SoftStopTable:
    """One `[[scene.soft_stops]]`: the arguments of `SoftStop`."""

    gap: float
    stiffness: float
    restitution: float | None = None
    damping: float | None = None
    exponent: float | None = None
    law: Literal["power", "hunt-crossley"] | None = None
    prestress: float | None = None
    adhesive: bool | None = None
    side: Literal["right", "left"] = "right"


@frozen(kw_only=True)
class ModelTable:
    """`[model]`: a ready machine by its name, and its numbers."""

    name: str
    numbers: dict[str, float] = field(factory=dict)

    def build(self) -> AbstractScene:
        """The machine."""
        kinds = {name: x for name, x in vars(machines).items() if _is_machine(x)}
        if self.name not in kinds:
            raise ConfigError(unknown("machine", self.name, "[model]", sorted(kinds)))
        known = list(inspect.signature(kinds[self.name]).parameters)
        wrong = [name for name in self.numbers if name not in known]
        if wrong:
            raise ConfigError(*(unknown("number", x, "[model.numbers]", known) for x in wrong))
        with in_terms_of("[model.numbers]"):
            return kinds[self.name](**self.numbers)


def _is_machine(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, AbstractScene)


@frozen(kw_only=True)
class MotorTable:
    """`[scene.motor]`: the numbers of `Motor`, or of `DCMotor` with `electrical_time`."""

    strength: float
    control: float
    coupling: float
    slider_inertia: float
    no_load_speed: float | None = None
    electrical_time: float | None = None

    def build(self) -> Motor:
        """The drive."""
        return (Motor if self.electrical_time is None else DCMotor)(**given(self))


@frozen(kw_only=True)
class SceneTable:
    """`[scene]`: dimensionless numbers."""

    drive: Literal["ideal", "motor"] = "ideal"
    frequency_ratio: float | None = None
    motor: MotorTable | None = None
    damping_ratio: float = 0.0
    restitution: float = 0.5
    gap: float | None = None
    stops: tuple[StopTable, ...] | None = None
    soft_stops: tuple[SoftStopTable, ...] = ()
    crank: Literal["cosine", "slider"] = "cosine"
    crank_ratio: float | None = None
    clock: Literal["phase", "time"] = "phase"

    def build(self) -> Scene:
        """The scene; without `gap` and stops it has one stop on the right at gap 2."""
        self._check()
        stops = []
        for i, stop in enumerate(self.stops or ()):
            bounce = self.restitution if stop.restitution is None else stop.restitution
            with in_terms_of(f"[[scene.stops]] number {i + 1}"):
                stops.append(RigidStop(stop.gap, bounce, side=stop.side))
        soft = []
        for i, stop in enumerate(self.soft_stops):
            with in_terms_of(f"[[scene.soft_stops]] number {i + 1}"):
                soft.append(SoftStop(**given(stop)))
        with in_terms_of("[scene.motor]"):
            turning = None if self.motor is None else self.motor.build()
        with in_terms_of("[scene]"):
            if self.stops is None and (self.gap is not None or not soft):
                stops = [RigidStop(2.0 if self.gap is None else self.gap, self.restitution)]
            return Scene(
                oscillator=Oscillator(self.damping_ratio),
                drive=turning or IdealDrive(self.frequency_ratio),
                stops=tuple(stops),
                soft_stops=tuple(soft),
                clock_name=self.clock,
                **({} if self.crank_ratio is None else {"crank": SliderCrank(self.crank_ratio)}),
            )

    def _check(self) -> None:
        for drive, key in (("ideal", "frequency_ratio"), ("motor", "motor")):
            if (getattr(self, key) is not None) != (drive == self.drive):
                what = "missing key" if drive == self.drive else "unfitting key"
                raise ConfigError(f'{what} `{key}` in [scene]: drive = "{self.drive}"')
        if self.stops is not None and self.gap is not None:
            raise ConfigError("[scene] must hold `gap` or [[scene.stops]], but holds both")
        if (self.crank_ratio is not None) != (self.crank == "slider"):
            raise ConfigError('`crank_ratio` in [scene] must stand beside crank = "slider"')


def start_of(scene: AbstractScene, numbers: Mapping[str, float], place: str) -> Any:
    """A state on the section, from `[start]` or a guess."""
    known = list(inspect.signature(scene.start).parameters)
    wrong = [unknown("key", name, place, known) for name in numbers if name not in known]
    if wrong:
        raise ConfigError(*wrong)
    with in_terms_of(place):
        return scene.start(**numbers)


@frozen(kw_only=True)
class MethodTable:
    """`[method]`: how the scene is carried."""

    name: Literal["draft", "standard", "reference", "exact-flight", "adaptive", "fixed-step"]
    solver: str | None = None
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

    def search(self) -> AbstractSearch:
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
    """A whole file."""

    machine: MachineTable | None = None
    scene: SceneTable | None = None
    model: ModelTable | None = None
    start: dict[str, float] | None = None
    method: MethodTable | None = None
    axes: dict[str, Row] | None = None
    scan: ScanTable | None = None
    sweep: SweepTable | None = None
    basins: BasinsTable | None = None
    orbit: OrbitTable | None = None
    simulate: SimulateTable | None = None

    own: AbstractScene | None = field(init=False, default=None)
    """A machine that the command line names, not the file."""

    def build(self) -> tuple[AbstractScene, Any, AbstractMethod | str | None]:
        """Scene, start and method; `None` for what the file leaves out."""
        names = [name for name in ("scene", "machine", "model") if getattr(self, name) is not None]
        held = " and ".join(f"[{name}]" for name in names) or "none of them"
        if self.own is not None and names:
            raise ConfigError(
                f"the file must not describe a machine beside --machine, but has {held}"
            )
        if self.own is None and len(names) != 1:
            raise ConfigError(f"the file must hold [scene], [machine] or [model], but holds {held}")
        scene = self.own or getattr(self, names[0]).build()
        start = None if self.start is None else start_of(scene, self.start, "[start]")
        return scene, start, self.method and self.method.build()


def read(path: str | Path, *, machine: str | None = None) -> Config:
    """Read a file; with `machine`, a name `package.module:function`, for the machine that this
    function returns. **Raises:** `ConfigError` that names every fault with its place."""
    config = read_toml(path, Config)
    if machine is not None:
        object.__setattr__(config, "own", _called(machine))
    return config


def _called(name: str) -> AbstractScene:
    """The machine that a function of this name returns."""
    module, _, function = name.partition(":")
    if not module or not function:
        raise ConfigError(f"--machine must be package.module:function, but is {name!r}")
    try:
        with _beside():
            found = getattr(importlib.import_module(module), function)()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"--machine {name} cannot be found: {error}") from None
    if not isinstance(found, AbstractScene):
        raise ConfigError(f"--machine {name} must return a machine, but returned {found!r}")
    return found


@contextmanager
def _beside() -> Iterator[None]:
    """Modules of the folder in which the command is run can be imported, as by `python -m`."""
    sys.path.insert(0, "")
    try:
        yield
    finally:
        sys.path.remove("")
