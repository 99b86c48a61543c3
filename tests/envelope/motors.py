"""Motors, weak and strong."""

from math import pi

import numpy as np
import vi_jax as vi

from .case import STEPPED, Found, case
from .scenes import MOTOR, against_scipy, energy, free_machine, ideal, machine, sections, worst


@case(
    "τ0 = 0",
    "the shaft coasts: the energy is kept, 200 cycles",
    # Nothing brings back what a step loses: the loss grows with the number of steps.
    {"FixedStep(10)": 1e-7, "Adaptive(1e-11)": 1e-9},
)
def coasting() -> Found:
    """No torque."""
    scene, found = free_machine(), {}
    start = scene.start(Y=-1.0, V=0.3, W=0.9)
    for name, method in STEPPED.items():
        run = vi.simulate(scene, start, 200, method=method)
        found[name] = float(abs(energy(scene, run.last) / energy(scene, start) - 1))
    return found


@case(
    "τ0 = 0, W → 0",
    "the shaft swings to and fro; in time the energy is kept",
    {"FixedStep(10)": 1e-5, "Adaptive(1e-11)": 1e-8},
    "the phase clock ends as `stalled`; in time a cycle that never ends, as `max_steps`",
)
def stalling() -> Found:
    """A stall and a reversal."""
    scene = free_machine(coupling=1.0)
    start = scene.start(Y=-1.0, V=0.0, W=0.05)
    if vi.simulate(scene, start, 3).result != vi.RESULTS.stalled:
        return dict.fromkeys(STEPPED, np.inf)
    found = {}
    timed = scene.in_clock("time")
    # Swings last long: a scene of its own clock is observed as often as asked.
    for name, method in STEPPED.items():
        watched = Watched(scene=timed, contacts=timed.stops)
        run = vi.simulate(watched, timed.adopt(start), 40, method=method)
        turned_back = bool((run.sections.W < 0).any())
        change = energy(scene, run.last) / energy(scene, start) - 1
        found[name] = float(abs(change)) if turned_back and bool(run.successful) else np.inf
    return found


class Watched(vi.AbstractMachine):
    """A motor scene observed once in a time of 2π, wherever its crank is."""

    scene: vi.Scene
    contacts: tuple  # pyright: ignore

    @property
    def cycle(self):
        """2π of time τ."""
        return 2 * pi

    def field(self, s, state):
        """That of the scene in its time clock."""
        return self.scene.field(s, state)

    def step_limit(self, s, state):
        """That of the scene."""
        return self.scene.step_limit(s, state)


@case(
    "τ0 = 10³ and 10⁴",
    "to the ideal drive as 1/τ0: deviation times τ0 is the same at both (relative)",
    {"Adaptive(1e-11)": 0.02},
    "explicit steps grow as τ0; above 2·10⁴ a cycle takes 65,536 of them and the lane ends as "
    "`max_steps`: take the ideal drive, which is as near as 1/τ0 (see below)",
)
def strong_motor() -> Found:
    """The ideal limit."""
    method = STEPPED["Adaptive(1e-11)"]
    still = ideal(0.9, 0.05, [(1, 2.0, 0.5)])
    limit = sections(still, still.start(), 3, vi.ExactFlight())[-1]
    scaled = []
    for tau0 in (1e3, 1e4):
        scene, _ = machine(**{**MOTOR, "tau0": tau0})
        end = sections(scene, scene.start(), 3, method)[-1]
        scaled.append(float(np.abs(end[:2] - limit).max()) * tau0)
    scene, _ = machine(**{**MOTOR, "tau0": 1e6})
    if vi.simulate(scene, scene.start(), 1, method=method).result != vi.RESULTS.max_steps:
        return {"Adaptive(1e-11)": np.inf}
    return {"Adaptive(1e-11)": max(abs(x / scaled[0] - 1) for x in scaled)}


@case("ε = 1 and 10", "SciPy, 5 cycles", {"FixedStep(10)": 1e-5, "Adaptive(1e-11)": 1e-8})
def strong_feedback() -> Found:
    """A spring that rules the shaft."""
    return worst(
        against_scipy([0.0, 0.0, 2.0], 5, **{**MOTOR, "eps": 1.0, "tau0": 3.0, "kappa": 2.0}),
        against_scipy([0.0, 0.0, 8.0], 5, **{**MOTOR, "eps": 10.0, "tau0": 30.0, "kappa": 8.0}),
    )


@case(
    "λ = 0.99", "SciPy with the exact crank, 10 cycles",
    {"FixedStep(10)": 1e-3, "Adaptive(1e-11)": 1e-8},
    "λ ≥ 1 is refused; from λ = 0.9 on fixed steps need to be many",
)  # fmt: skip
def long_crank() -> Found:
    """A crank nearly as long as its rod."""
    try:
        vi.SliderCrank(1.0)
    except ValueError:
        return against_scipy([0.0, 0.0, 0.9], 10, ratio=0.99, **MOTOR)
    return dict.fromkeys(STEPPED, np.inf)
