"""The choice of a machine's method: a given one, a preset by its name, or the default."""

from ..._checks import one_of
from ...machine import AbstractMachine, scales_known
from .base import AbstractMethod
from .exact import ExactFlight, lack_of_closed_form
from .runge_kutta import Adaptive, FixedStep

MethodLike = AbstractMethod | str | None
"""The values of an argument `method`: a method, the name of a preset, or `None` for the default."""

# Steps in a cycle of a `Scene`, and the tolerance for other machines, whose time scales are not
# known. Chosen from the front that `experiments/benchmarks/speed_accuracy.py` measures.
_PRESETS = {"draft": (6, 1e-6), "standard": (10, 1e-9), "reference": (30, 1e-13)}


def preset(machine: AbstractMachine | None, name: str = "standard") -> AbstractMethod:
    """Return the method of this name for a machine; every argument `method` accepts the name too.

    **Arguments:** `machine`, or `None` if it is not known yet; `name`, `"draft"`, `"standard"` or
    `"reference"`.

    For an ideal drive with a `CosineCrank` every name returns `ExactFlight`, the fastest and most
    accurate method. For other machines the names have the meanings below. Errors were measured on
    Table 1's machine (d = 2, k = 0.8, κ from 0.5 to 1.9): 95 of 100 lanes that are not chaotic had
    a smaller error of the section state after 1,000 cycles.

    - `"draft"`: 6 steps of `Verner9` in a cycle, error 3e-7 (median 8e-9), in 0.7 of the time of
      `"standard"`;
    - `"standard"`: 10 steps, error 2e-9 (5e-11);
    - `"reference"`: 30 steps, error 6e-14 (2e-15), in 2.8 times the time of `"standard"`.
      `Taylor(20, rtol=1e-13)` is as accurate in 0.75 of that, for fields that have a series.

    No settled motion of 1,024 got a wrong regime under either of the first two.

    Strong damping (ξ > 0.5) or a strong motor (τ0 > 1) shortens the steps, which keeps the errors
    small. Other machines, whose time scales are not known, get `Adaptive` with the tolerances 1e-6,
    1e-9 and 1e-13, the last with at least ten steps in a cycle instead of five.

    **Raises:** `ValueError` for another name.
    """
    return _named(machine, name, "name")


def _named(machine: AbstractMachine | None, name: str, argument: str) -> AbstractMethod:
    steps, tolerance = _PRESETS[one_of(argument, name, tuple(_PRESETS))]
    if machine is not None and lack_of_closed_form(machine) is None:
        return ExactFlight()
    if machine is None or scales_known(machine):
        return FixedStep(steps_per_cycle=steps)
    return Adaptive(rtol=tolerance, steps_per_cycle=10 if name == "reference" else 5)


def chosen(
    machine: AbstractMachine | None,
    method: object,
    otherwise: AbstractMethod | None = None,
    *,
    argument: str = "method",
) -> AbstractMethod:
    """Return the given method, or the preset of the given name. For `None`, return `ExactFlight` if
    it applies, else `otherwise`, by default the `"standard"` preset. `AbstractMethod.check` decides
    whether it can integrate the machine."""
    if method is None:
        if otherwise is None or (machine is not None and lack_of_closed_form(machine) is None):
            return preset(machine)
        return otherwise
    if isinstance(method, str):
        return _named(machine, method, argument)
    if not isinstance(method, AbstractMethod):
        raise TypeError(
            f"Argument `{argument}` must be `Adaptive(...)`, `FixedStep(...)`, `Taylor(...)`, "
            f"`ExactFlight()` or the name of a preset, but got {method!r}."
        )
    return method
