"""Gaps, far ones and none."""

from math import acos, pi, sin

import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.linalg import expm

from .case import ALL, STEPPED, Found, case, within
from .independent import flown
from .scenes import deviations, halves, ideal, sections, worst


@case(
    "d = 0, -0.5, -0.9 and -0.99, k = 0",
    "held while cos φ > d, then released, if only for a moment",
    within(1e-10, 1e-7, 1e-8),
)
def pressed() -> Found:
    """A body that its spring presses on."""
    return worst(
        deviations(0.3, 0.1, [(1, 0.0, 0.0)], -1.0, 0.0, 10),
        deviations(0.7, 0.0, [(1, -0.5, 0.0)], -1.0, 0.0, 10),
        *(deviations(1.1, 0.05, [(1, d, 0.0)], d, 0.0, 5) for d in (-0.9, -0.99)),
    )


@case("d = -1.5, k = 0.5", "pressed on in every phase, the body ends at rest", within(0, 0, 0))
def always_pressed() -> Found:
    """Rest for ever."""
    scene, found = ideal(0.9, 0.0, [(1, -1.5, 0.5)]), {}
    for name, method in ALL.items():
        run = vi.simulate(scene, scene.start(Y=-3.0), 5, settle=20, method=method)
        off = jnp.abs(run.sections.Y + 1.5) + jnp.abs(run.sections.V)
        good = bool(run.successful) and int(jnp.sum(run.impacts)) == 0
        found[name] = float(jnp.max(off)) if good else np.inf
    return found


@case(
    "d within 10⁻¹² of the free amplitude",
    "an impact below it, none above; one cycle on the free motion",
    {"ExactFlight": 0, "Adaptive(1e-11), 10⁻⁹": 0},
    "`Adaptive` sees a graze as deep as a hundred times its tolerance",
)
def grazing() -> Found:
    """Grazing, either side."""
    zeta, xi = 0.9, 0.05
    response = 1 / (1 - zeta**2 + 2j * xi * zeta)
    methods = {
        "ExactFlight": (vi.ExactFlight(), 1e-12),
        "Adaptive(1e-11), 10⁻⁹": (STEPPED["Adaptive(1e-11)"], 1e-9),
    }
    found = {}
    for name, (method, depth) in methods.items():
        wrong = 0
        for side in (-1, 1):
            scene = ideal(zeta, xi, [(1, abs(response) * (1 + side * depth), 0.5)])
            start = scene.start(Y=response.real, V=-zeta * response.imag)
            wrong += int(vi.simulate(scene, start, 1, method=method).impacts[0]) != (side < 0)
        found[name] = float(wrong)
    return found


@case("d = 10⁶ and 10¹⁵⁰", "as without the stop", within(1e-14, 1e-14, 1e-14))
def far_stop() -> Found:
    """A stop that is never met."""
    found = {}
    for name, method in ALL.items():
        none = ideal(0.9, 0.01, [])
        free = sections(none, none.start(), 10, method)
        off = 0.0
        for gap in (1e6, 1e150):
            scene = ideal(0.9, 0.01, [(1, gap, 0.5)])
            off = max(off, float(np.abs(sections(scene, scene.start(), 10, method) - free).max()))
        found[name] = off
    return found


@case(
    "two stops 10⁻⁶ apart",
    "rest on one side, then on the other, twice a cycle; Y within the room",
    within(1e-12, 1e-12, 1e-12),
)
def narrow() -> Found:
    """Hardly any room."""
    scene = ideal(0.5, 0.05, [(1, 0.3, 0.5), (-1, -0.3 + 1e-6, 0.5)])
    found = {}
    for name, method in ALL.items():
        run = vi.simulate(scene, scene.start(Y=0.3 - 5e-7), 4, settle=4, method=method)
        assert run.rests is not None and run.y_max is not None and run.y_min is not None
        good = bool(run.successful) and bool((run.rests == 2).all())
        over = jnp.maximum(run.y_max - 0.3, 0.3 - 1e-6 - run.y_min)
        found[name] = max(float(jnp.max(over)), 0.0) if good else np.inf
    return found


@case(
    "starts on the stop, V > 0, < 0, = 0",
    "struck at once; leaves; held until cos φ = d; leaves",
    within(1e-10, 1e-8, 1e-9),
)
def on_the_stop() -> Found:
    """Every way to begin on a stop."""
    found = {}
    for name, method in ALL.items():
        off = 0.0
        for gap, V, same in ((2.0, 1.0, -0.5), (2.0, -1.0, -1.0), (2.0, 0.0, 0.0)):
            scene = ideal(0.9, 0.05, [(1, gap, 0.5)])
            mine = halves(scene, scene.start(Y=gap, V=V), 3, method)[1:]
            truth = flown(0.9, 0.05, [(1, gap, 0.5)], gap, same, 3)[1:]
            off = max(off, float(np.abs(mine - truth).max()))
        # Held: the flight begins at the release, at φ = arccos d.
        scene = ideal(0.9, 0.05, [(1, 0.5, 0.5)])
        run = vi.simulate(scene, scene.start(Y=0.5), 1, method=method, samples=6)
        assert run.samples is not None
        off = max(off, float(abs(run.samples.state.Y[1] - 0.5)))
        z = np.array([0.5, 0.0, 0.5, sin(acos(0.5))])
        matrix = np.array([[0, 1, 0, 0], [-1, -0.1, 1, 0], [0, 0, 0, -0.9], [0, 0, 0.9, 0]])
        flight = expm(matrix * (pi / 3 / 0.9)) @ z
        off = max(off, float(abs(run.samples.state.Y[2] - flight[0])))
        found[name] = off
    return found
