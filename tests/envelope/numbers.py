"""Numbers: tiny ones, single precision, bounds, and a million cycles."""

import warnings
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

from .case import ALL, QUICK, Found, case, within
from .independent import flown
from .scenes import halves, ideal, sections


@case("denormal numbers", "as zeros in their place", within(1e-15, 1e-15, 1e-15))
def denormals() -> Found:
    """Numbers below the least normal one."""
    found = {}
    tiny = 5e-324
    for name, method in ALL.items():
        small = ideal(0.9, tiny, [(1, 2.0, tiny)])
        zero = ideal(0.9, 0.0, [(1, 2.0, 0.0)])
        a = sections(small, small.start(Y=tiny, V=-tiny), 20, method)
        b = sections(zero, zero.start(), 20, method)
        found[name] = float(np.abs(a - b).max())
    return found


@case(
    "rtol = 10⁻¹ … 10⁻¹⁵",
    "error of the state after 20 cycles, over the tolerance (or 10⁻¹³)",
    {"Adaptive": 10.0},
    "below 8 roundings the tolerance is taken as 8 roundings",
)
def tolerances() -> Found:
    """Every tolerance."""
    scene = ideal(0.9, 0.05, [(1, 2.0, 0.5)])
    truth = sections(scene, scene.start(), 20, vi.ExactFlight())[-1]
    worst_ratio = 0.0
    for n in range(1, 16):
        method = vi.Adaptive(rtol=10.0**-n)
        error = np.abs(sections(scene, scene.start(), 20, method)[-1] - truth).max()
        worst_ratio = max(worst_ratio, float(error) / max(10.0**-n, 1e-13))
    return {"Adaptive": worst_ratio}


@case("`max_steps` = 10", "every method ends there, and says so", within(0, 0, 0))
def step_limits() -> Found:
    """A bound on the work."""
    scene, found = ideal(0.9, 0.05, [(1, 2.0, 0.5)]), {}
    for name, method in ALL.items():
        run = vi.simulate(scene, scene.start(), 100, method=method, max_steps=10)
        said = run.result == vi.RESULTS.max_steps
        found[name] = 0.0 if bool(said) and int(run.steps) == 10 else np.inf
    return found


@case(
    "10⁶ lanes, a hundred of them NaN",
    "the others bit for bit as without them; those end as `bad_start`",
    {"ExactFlight": 0},
    long=True,
)
def poisoned() -> Found:
    """Lanes that harm no other."""
    lanes = 10**5 if QUICK else 10**6

    def last(zeta):
        scene = vi.Scene.ideal(frequency_ratio=zeta)
        run = vi.simulate(scene, scene.start(), 1, method=vi.ExactFlight(), record="sections")
        return run.last.Y, run.result == vi.RESULTS.bad_start

    run = vi.jit(jax.vmap(last))
    zeta = np.linspace(0.5, 1.9, lanes)
    clean, _ = run(jnp.asarray(zeta))
    bad = np.random.default_rng(1).choice(lanes, 100, replace=False)
    zeta[bad] = np.nan
    mixed, refused = run(jnp.asarray(zeta))
    others = np.ones(lanes, bool)
    others[bad] = False
    same = np.array_equal(np.asarray(clean)[others], np.asarray(mixed)[others])
    named = np.array_equal(np.asarray(refused), ~others)
    return {"ExactFlight": 0.0 if same and named else np.inf}


SINGLE = {
    "ExactFlight, float32": vi.ExactFlight(),
    "FixedStep(10), float32": vi.FixedStep(),
    "Adaptive(1e-5), float32": vi.Adaptive(rtol=1e-5),
}


@case(
    "float32 at k = 0 … 0.999, ξ = 0 … 10, ζ = 10⁻² … 10², d = -0.5 … 2",
    "matrix exponentials in float64, a few cycles",
    dict(zip(SINGLE, (1e-4, 1e-4, 1e-4), strict=True)),
    "the floor is 1e-6; near resonance and with k → 1 errors grow as there is nothing to damp them",
)
def single() -> Found:
    """Single precision through the corners."""
    corners = [
        (0.9, 0.05, [(1, 2.0, 0.0)], 0.0, 0.0, 10),
        (0.99, 0.001, [(1, 2.0, 0.999)], 0.0, 0.0, 5),
        (0.9, 0.0, [(1, 1.2, 0.5)], 0.0, 1.0, 3),
        (0.9, 1.0, [(1, 1.2, 0.5)], 0.0, 10.0, 3),
        (0.9, 10.0, [(1, 1.2, 0.5)], 0.0, 60.0, 3),
        (1e-2, 0.01, [(1, 2.0, 0.8)], 0.0, 4.0, 1),
        (1e2, 0.01, [(1, 0.5, 0.8)], 0.0, 2.0, 100),
        (0.3, 0.1, [(1, 0.0, 0.0)], -1.0, 0.0, 5),
        (0.5, 0.05, [(1, -0.5, 0.0)], -1.0, 0.0, 5),
    ]
    truths = [flown(*corner) for corner in corners]
    found = dict.fromkeys(SINGLE, 0.0)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="vi_jax is running in single precision")
        for (zeta, xi, stops, Y, V, cycles), truth in zip(corners, truths, strict=True):
            for name, method in SINGLE.items():
                scene = ideal(zeta, xi, stops)
                mine = halves(scene, scene.start(Y=Y, V=V), cycles, method)
                assert mine.dtype == np.float32
                off = float(np.max(np.abs(mine - truth) / (1 + np.abs(truth))))
                found[name] = max(found[name], off)
    return found


def drift(method: vi.AbstractMethod, cycles: int) -> float:
    """Distance to the orbit after so many cycles from it; its impact phase included."""
    scene = vi.Scene.ideal(frequency_ratio=0.9)
    closed = vi.closed_form_orbits(scene, cycles=2)
    start = scene.start(Y=closed.Y[0], V=closed.V[0])
    run = vi.simulate(scene, start, 2, settle=cycles, method=method, impact_log=1)
    assert run.impact_log is not None
    if not bool(run.successful):
        return np.inf
    off = max(abs(float(run.last.Y - start.Y)), abs(float(run.last.V - start.V)))
    phases = np.asarray(run.impact_log.phase).ravel()
    phase = float(phases[np.isfinite(phases)][0])
    return max(off, abs(phase - float(closed.impact_phase[0]) % (2 * pi)))


@case(
    "10⁶ cycles of the stable 4π motion",
    "the closed form, impact phase included; no farther off than after 10³ cycles (factor 3)",
    {"ExactFlight": 1e-9, "FixedStep(20), 10⁵": 1e-9, "ExactFlight, float32": 1e-4},
    long=True,
)
def million() -> Found:
    """Nothing degrades with the number of cycles."""
    many = 10**5 if QUICK else 10**6
    found = {}
    steps = vi.FixedStep(steps_per_cycle=20)
    for name, method, cycles in (
        ("ExactFlight", vi.ExactFlight(), many),
        ("FixedStep(20), 10⁵", steps, 10**5),
    ):
        early, late = drift(method, 10**3), drift(method, cycles)
        found[name] = late if late <= 3 * early + 1e-14 else np.inf
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="vi_jax is running in single precision")
        early, late = drift(vi.ExactFlight(), 10**3), drift(vi.ExactFlight(), many)
        found["ExactFlight, float32"] = late if late <= 3 * early + 1e-6 else np.inf
    return found
