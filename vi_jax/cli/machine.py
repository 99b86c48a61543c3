"""The tables of a file that describe a machine, and a machine named on the command line."""

import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from attrs import field, frozen

from .. import machines
from ..machine import (
    AbstractMachine,
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
from .toml import ConfigError, Tables, given, in_terms_of, keys_of, unknown


@frozen(kw_only=True)
class ParametersTable:
    """`[parameters]`: the numbers of `Parameters` in SI units."""

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
        """The scene, made dimensionless. **Raises:** `ConfigError`."""
        with in_terms_of("[parameters]"):
            table = Parameters(**given(self, "drive", "crank", "clock"))
            return table.scene(drive=self.drive, crank=self.crank).in_clock(self.clock)


@frozen(kw_only=True)
class StopTable:
    """One `[[scene.stops]]`: the arguments of `RigidStop`."""

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
class MachineTable:
    """`[machine]`: a ready machine by its name, and its numbers."""

    name: str
    numbers: dict[str, float] = field(factory=dict)

    def build(self) -> AbstractMachine:
        """The machine. **Raises:** `ConfigError` for a name or a number that is none."""
        kinds = {name: x for name, x in vars(machines).items() if _is_machine(x)}
        if self.name not in kinds:
            raise ConfigError(unknown("machine", self.name, "[machine]", sorted(kinds)))
        known = list(inspect.signature(kinds[self.name]).parameters)
        wrong = [name for name in self.numbers if name not in known]
        if wrong:
            raise ConfigError(*(unknown("number", x, "[machine.numbers]", known) for x in wrong))
        with in_terms_of("[machine.numbers]"):
            return kinds[self.name](**self.numbers)


def _is_machine(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, AbstractMachine)


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
        """The drive that these numbers are of."""
        return (Motor if self.electrical_time is None else DCMotor)(**given(self))


@frozen(kw_only=True)
class SceneTable:
    """`[scene]`: the paper's machine in numbers without dimensions."""

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


def outdated(tables: Tables) -> list[str]:
    """Sentences about tables that have another name now: a ready machine's, and SI numbers'."""
    found = ["[model] is called [machine] now"] if "model" in tables else []
    inside = tables.get("machine")
    old = [key for key in keys_of(ParametersTable) if isinstance(inside, dict) and key in inside]
    if old:
        words = "the SI numbers of the paper's machine are in [parameters] now"
        found.append(f"`{old[0]}` in [machine]: {words}")
    return found


def start_of(machine: AbstractMachine, numbers: Mapping[str, float], place: str) -> Any:
    """A state on the section, from `[start]` or a guess."""
    known = list(inspect.signature(machine.start).parameters)
    wrong = [unknown("key", name, place, known) for name in numbers if name not in known]
    if wrong:
        raise ConfigError(*wrong)
    with in_terms_of(place):
        return machine.start(**numbers)


def machine_named(name: str) -> AbstractMachine:
    """The machine that a function of this name returns."""
    module, _, function = name.rpartition(":")
    if not module or not function:
        raise ConfigError(
            "--machine must be package.module:function or path/to/file.py:function, but is "
            f"{name!r}"
        )
    with _beside():
        try:
            make = getattr(_imported(module), function)
        except (ImportError, AttributeError, FileNotFoundError) as error:
            raise ConfigError(f"--machine {name} cannot be found: {error}") from None
        except Exception as error:
            raise _raised(name, error) from error
        if not _is_called_with_nothing(make):
            raise ConfigError(f"--machine {name} must be a function without arguments")
        try:
            found = make()
        except (Exception, SystemExit) as error:
            raise _raised(name, error) from error
    if not isinstance(found, AbstractMachine):
        raise ConfigError(f"--machine {name} must return a machine, but returned {found!r}")
    return found


def _imported(module: str) -> Any:
    """A module by its name, or a file by its path; what lies beside the file can be imported."""
    if not module.endswith(".py"):
        return importlib.import_module(module)
    path = Path(module).resolve()
    spec = importlib.util.spec_from_file_location(path.stem, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise FileNotFoundError(f"there is no file {module}")
    made = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = made  # where dataclasses look for what they are of
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(made)
    except BaseException:
        del sys.modules[path.stem]
        raise
    finally:
        sys.path.remove(str(path.parent))
    return made


def _is_called_with_nothing(make: Any) -> bool:
    try:
        inspect.signature(make).bind()
    except (TypeError, ValueError):  # the second of what does not tell its arguments
        return False
    return True


def _raised(name: str, error: BaseException) -> ConfigError:
    """What went wrong in a user's module, and on which of its lines."""
    module = name.rpartition(":")[0]
    own = getattr(sys.modules.get(module), "__file__", None)
    if module.endswith(".py"):
        own = str(Path(module).resolve())
    lines = traceback.extract_tb(error.__traceback__)
    last = ([line for line in lines if line.filename == own] or lines)[-1]
    where = f" ({last.filename}, line {last.lineno})"
    if isinstance(error, SyntaxError):  # which says itself where it is
        where = ""
    return ConfigError(f"--machine {name} raised {type(error).__name__}: {error}{where}")


@contextmanager
def _beside() -> Iterator[None]:
    """Modules of the folder in which the command is run can be imported, as by `python -m`."""
    sys.path.insert(0, "")
    try:
        yield
    finally:
        sys.path.remove("")
