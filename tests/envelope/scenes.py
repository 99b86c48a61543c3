"""What the package says, and how far that is from the truth."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .case import ALL, STEPPED, Found
from .independent import flown, turned


def ideal(zeta: float, xi: float, stops: list, **more: Any) -> vi.Scene:
    """An ideally driven scene; `stops` are (side, gap, k)."""
    sides = {1: "right", -1: "left"}
    return vi.Scene(
        oscillator=vi.Oscillator(xi),
        drive=vi.IdealDrive(zeta),
        stops=[vi.RigidStop(gap, k, sides[sign]) for sign, gap, k in stops],
        **more,
    )


def sections(scene: vi.Scene, start: Any, cycles: int, method: Any, **more: Any) -> np.ndarray:
    """Section states, one row a cycle. **Raises:** `RuntimeError` if the run failed."""
    run = vi.simulate(scene, start, cycles, method=method, **more)
    if not bool(run.successful):
        raise RuntimeError(vi.RESULTS[run.result])
    names = ["Y", "V", *(["W"] if hasattr(start, "W") else [])]
    return np.stack([np.asarray(getattr(run.sections, name)) for name in names], axis=1)


def halves(scene: vi.Scene, start: Any, cycles: int, method: Any) -> np.ndarray:
    """States in each half cycle. **Raises:** `RuntimeError` if the run failed."""
    run = vi.simulate(scene, start, cycles, method=method, samples=2)
    if not bool(run.successful):
        raise RuntimeError(vi.RESULTS[run.result])
    assert run.samples is not None
    return np.stack([np.asarray(run.samples.state.Y), np.asarray(run.samples.state.V)], axis=1)


def deviations(
    zeta: float, xi: float, stops: list, Y: float, V: float, cycles: int, methods: Any = None
) -> Found:
    """States in each half cycle beside matrix exponentials, relative to 1 + |state|."""
    scene, truth = ideal(zeta, xi, stops), flown(zeta, xi, stops, Y, V, cycles)
    found = {}
    for name, method in (methods or ALL).items():
        mine = halves(scene, scene.start(Y=Y, V=V), cycles, method)
        found[name] = float(np.max(np.abs(mine - truth) / (1 + np.abs(truth))))
    return found


def worst(*found: Found) -> Found:
    """The largest of several deviations."""
    return {name: max(one[name] for one in found) for name in found[0]}


def energy(scene: vi.Scene, state: Any) -> Any:
    """E of the undamped, undriven machine: ½V² + ½(Y - U)² + ½(1 + μU_φ²)W²/ε."""
    drive: Any = scene.drive
    slide = scene.crank.slide(getattr(state, "phase", jnp.zeros_like(state.Y)))
    shaft = 0.5 * drive.inertia(slide) * state.W**2 / drive.coupling
    return 0.5 * state.V**2 + 0.5 * (state.Y - slide.U) ** 2 + shaft


def free_machine(coupling: float = 0.01, control: float = 0.0) -> vi.Scene:
    """No torque, no damping, k = 1: nothing takes energy."""
    drive = vi.Motor(0.0, control, coupling, 0.005)
    return vi.Scene(oscillator=vi.Oscillator(0.0), drive=drive, stops=[vi.RigidStop(0.5, 1.0)])


def machine(xi: float = 0.05, stops: Any = ((1, 2.0, 0.5),), ratio: float = 0.0, **motor: float):
    """A motor scene, and the same numbers for `turned`."""
    crank = vi.SliderCrank(ratio) if ratio else vi.CosineCrank()
    scene = vi.Scene(
        oscillator=vi.Oscillator(xi),
        drive=vi.Motor(motor["tau0"], motor["kappa"], motor["eps"], motor["mu"]),
        stops=[vi.RigidStop(gap, k, "right" if sign > 0 else "left") for sign, gap, k in stops],
        crank=crank,
    )
    return scene, {"xi": xi, **motor}


def against_scipy(start: list, cycles: int, **options: Any) -> Found:
    """Section states of a motor beside SciPy's."""
    scene, numbers = machine(**options)
    truth = turned(
        numbers, options.get("stops", [(1, 2.0, 0.5)]), start, cycles, options.get("ratio", 0.0)
    )
    found = {}
    for name, method in STEPPED.items():
        state = scene.start(Y=start[0], V=start[1], W=start[2])
        mine = sections(scene, state, cycles, method)
        found[name] = float(np.max(np.abs(mine - truth) / (1 + np.abs(truth))))
    return found


MOTOR = {"tau0": 0.65, "kappa": 0.9, "eps": 0.01, "mu": 0.005}
