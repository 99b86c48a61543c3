"""The methods that `speed_accuracy.py` compares, the machine they run, and compiled batches."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import vi_jax as vi
from tools.study import QUICK

DRIVES = ("ideal",) if QUICK else ("ideal", "motor")
TABLE = vi.Parameters(torque=10.0, restitution=0.8, gap=0.08)


class Choice(NamedTuple):
    """A method and a precision."""

    family: str
    label: str
    method: vi.AbstractMethod
    double: bool = True

    @property
    def name(self) -> str:
        """The name in the tables."""
        return f"{self.family}, {self.label}"


def named(solver: str) -> Any:
    """Return a solver of vi_jax or diffrax by its name."""
    return vi.Verner9() if solver == "Verner9" else getattr(diffrax, solver)()


def fixed(solver: str, steps: int, *, double: bool = True) -> Choice:
    """Return a method with a fixed number of steps per cycle."""
    single = "" if double else ", float32"
    method = vi.FixedStep(named(solver), steps)
    return Choice(f"FixedStep {solver}{single}", f"{steps} steps", method, double)


def adaptive(solver: str, tolerance: float, *, double: bool = True) -> Choice:
    """Return a method with steps controlled by a tolerance."""
    single = "" if double else ", float32"
    method = vi.Adaptive(named(solver), rtol=tolerance)
    return Choice(f"Adaptive {solver}{single}", f"{tolerance:.0e}", method, double)


def series(order: int, tolerance: float) -> Choice:
    """Return power series with steps controlled by a tolerance."""
    return Choice(f"Taylor {order}", f"{tolerance:.0e}", vi.Taylor(order, rtol=tolerance))


def series_of(order: int) -> Choice:
    """Return power series with eight steps per cycle."""
    return Choice("Taylor, 8 steps", f"order {order}", vi.Taylor(order, 8))


EXACT = Choice("ExactFlight", "closed form", vi.ExactFlight())
if QUICK:
    CARRIED = [fixed("Verner9", 10), adaptive("Verner9", 1e-9)]
else:
    CARRIED = [
        *(fixed("Verner9", n) for n in (5, 6, 8, 10, 12, 16, 20, 30)),
        *(fixed("Dopri8", n) for n in (5, 6, 8, 12, 16, 24, 32, 48)),
        *(fixed("Tsit5", n) for n in (5, 8, 16, 32, 64, 128)),
        *(fixed("Dopri5", n) for n in (8, 32, 128)),
        *(fixed("Bosh3", n) for n in (16, 64, 256)),
        *(adaptive("Verner9", 10.0**-n) for n in (2, 4, 6, 8, 9, 10, 12, 13)),
        *(adaptive("Dopri8", 10.0**-n) for n in (4, 6, 9, 12)),
        *(adaptive("Tsit5", 10.0**-n) for n in (3, 5, 7, 9, 11)),
        *(adaptive("Dopri5", 10.0**-n) for n in (3, 6, 9)),
        *(adaptive("Bosh3", 10.0**-n) for n in (3, 5, 7)),
        *(series(12, 10.0**-n) for n in (5, 7, 9)),
        *(series(16, 10.0**-n) for n in (7, 9, 11)),
        *(series(20, 10.0**-n) for n in (9, 11, 12, 13, 14)),
        *(series_of(n) for n in (10, 12, 14, 16, 18, 20)),
        fixed("Verner9", 6, double=False),
        fixed("Tsit5", 16, double=False),
        adaptive("Verner9", 1e-5, double=False),
    ]
SCANNED = {
    "ExactFlight, closed form",
    "ExactFlight, float32, closed form",
    *(fixed("Verner9", n).name for n in (5, 6, 10, 16)),
    *(fixed("Dopri8", n).name for n in (6, 12)),
    fixed("Tsit5", 16).name,
    fixed("Verner9", 6, double=False).name,
    series(16, 1e-9).name,
    series(20, 1e-13).name,
    series_of(14).name,
    *(choice.name for choice in CARRIED if choice.method.adaptive and choice.double),
}
TRUTH = {"ideal": EXACT, "motor": fixed("Verner9", 40)}
SINGLE_EXACT = EXACT._replace(family="ExactFlight, float32", double=False)
CHOICES = {"ideal": [EXACT, SINGLE_EXACT, *CARRIED], "motor": CARRIED}


MACHINES = {drive: jtu.tree_map(np.asarray, TABLE.scene(drive=drive)) for drive in DRIVES}


def machine_of(drive: str, ratio: Any, restitution: Any = 0.8) -> vi.Scene:
    """Return Table 1's machine at ζ (ideal) or κ (motor) = `ratio`, in the current precision."""
    machine = jtu.tree_map(jnp.asarray, MACHINES[drive])

    def numbers(machine):
        drive = machine.drive
        ratio = drive.frequency_ratio if isinstance(drive, vi.IdealDrive) else drive.control
        return ratio, machine.stops[0].restitution

    return eqx.tree_at(numbers, machine, (jnp.asarray(ratio), jnp.asarray(restitution)))


def ratios(lanes: int) -> np.ndarray:
    """Return ζ or κ of the lanes."""
    return np.linspace(0.5, 1.9, lanes)


class Program(NamedTuple):
    """A compiled batch with its arguments."""

    run: Callable[[], Any]
    compiling: float


_compiled: dict[tuple, tuple[Any, float]] = {}


def carried(kind: str, choice: Choice, function: Callable, *arguments: np.ndarray) -> Program:
    """Compile `function` of a method and a batch in the choice's precision.

    Tolerances are arguments of the program: a family of adaptive methods is one program.
    """
    tolerances, rest = eqx.partition(choice.method, lambda x: isinstance(x, np.ndarray))
    with jax.enable_x64(choice.double):
        batch = [jtu.tree_map(jnp.asarray, x) for x in (tolerances, *arguments)]
        key = (kind, choice.family, "" if choice.method.adaptive else choice.label)
        if key not in _compiled:

            def program(tolerances, *batch):
                return function(eqx.combine(tolerances, rest), *batch)

            begin = time.perf_counter()
            compiled = vi.jit(program).lower(*batch).compile()
            _compiled[key] = compiled, time.perf_counter() - begin
    compiled, seconds = _compiled[key]
    return Program(lambda: jax.block_until_ready(compiled(*batch)), seconds)


def forget(*kinds: str) -> None:
    """Delete compiled programs, because the memory maps of a process are limited."""
    for key in [key for key in _compiled if key[0].endswith(kinds)]:
        del _compiled[key]
    jax.clear_caches()
