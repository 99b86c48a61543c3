"""Derivatives through impacts are the product of flights and saltation matrices."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.linalg import expm

from differences import quick, some

ZETA, XI, K, GAP = 0.9, 0.05, 0.5, 2.0
# Starts and cycles with one and with three impacts.
CASES = {1: (0.1, 0.2, 2), 3: (1.6, -1.9, 5)}


def final(method, cycles, *, extremes=False):
    def f(x):
        zeta, xi, k, d, Y, V = x
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=d, damping_ratio=xi)
        run = vi.simulate(scene, scene.start(Y=Y, V=V), cycles, method=method)
        if extremes:
            return jnp.stack([run.y_min[-1], run.y_max[0]])
        return jnp.stack([run.sections.Y[-1], run.sections.V[-1]])

    return f


def flight(time: float) -> np.ndarray:
    return expm(np.array([[0.0, 1.0], [-1.0, -2 * XI]]) * time)


def product(Y: float, V: float, cycles: int) -> tuple[np.ndarray, int]:
    """The monodromy matrix from impact phases and speeds, and the number of impacts."""
    scene = vi.Scene.ideal(frequency_ratio=ZETA, restitution=K, gap=GAP, damping_ratio=XI)
    run = vi.simulate(scene, scene.start(Y=Y, V=V), cycles, method=vi.ExactFlight(), impact_log=4)
    matrix, time, impacts = np.eye(2), 0.0, 0
    for cycle, row in enumerate(np.asarray(run.impact_log.phase)):
        for place, phase in enumerate(row[np.isfinite(row)]):
            speed = float(run.impact_log.speed[cycle, place])
            now = (2 * np.pi * cycle + phase) / ZETA
            before = np.cos(phase) - GAP - 2 * XI * speed
            after = np.cos(phase) - GAP + 2 * XI * K * speed
            saltation = np.array([[-K, 0.0], [(K * before + after) / speed, -K]])
            matrix = saltation @ flight(now - time) @ matrix
            time, impacts = now, impacts + 1
    return flight(2 * np.pi * cycles / ZETA - time) @ matrix, impacts


@pytest.mark.parametrize("impacts", CASES)
@pytest.mark.parametrize("jacobian", quick([jax.jacfwd, jax.jacrev], jax.jacrev))
@pytest.mark.parametrize(
    ("method", "tolerance"),
    [
        pytest.param(vi.ExactFlight(), 1e-9, id="ExactFlight"),
        pytest.param(
            vi.Adaptive(diffrax.Tsit5(), rtol=1e-11),
            1e-7,
            marks=pytest.mark.exhaustive,
            id="Adaptive",
        ),
    ],
)
def test_jacobian_is_the_product(method, tolerance, jacobian, impacts):
    Y, V, cycles = CASES[impacts]
    truth, counted = product(Y, V, cycles)
    assert counted == impacts
    f = final(method, cycles)
    parameters = jnp.array([ZETA, XI, K, GAP])
    found = jax.jit(jacobian(lambda x: f(jnp.concatenate([parameters, x]))))(jnp.array([Y, V]))
    np.testing.assert_allclose(found, truth, atol=tolerance)


@pytest.mark.parametrize("impacts", CASES)
def test_parameters_by_central_differences(impacts):
    Y, V, cycles = CASES[impacts]
    f = jax.jit(final(vi.ExactFlight(), cycles))
    x = jnp.array([ZETA, XI, K, GAP, Y, V])
    found = jax.jit(jax.jacfwd(f))(x)
    for i in range(6):
        h = 1e-6 * jnp.eye(6)[i]
        difference = (f(x + h) - f(x - h)) / 2e-6
        # The difference's own error: rounding 1e-15/1e-6, truncation (1e-6)² f'''.
        np.testing.assert_allclose(found[:, i], difference, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["phase", "time"])
def test_motor_control_by_central_differences(clock):
    def f(kappa):
        scene = vi.Parameters(torque=10.0, control=kappa).scene()
        run = vi.simulate(
            scene, scene.start(V=0.5, W=0.9), 4, method=vi.Adaptive(rtol=1e-11), clock=clock
        )
        state = run.sections
        return jnp.stack([state.Y[-1], state.V[-1], state.W[-1], run.duration[-1]])

    f = jax.jit(f)
    found = jax.jit(jax.jacfwd(f))(0.9)
    difference = (f(0.9 + 1e-5) - f(0.9 - 1e-5)) / 2e-5
    np.testing.assert_allclose(found, difference, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [vi.ExactFlight(), pytest.param(vi.Adaptive(rtol=1e-12), marks=pytest.mark.exhaustive)],
    ids=["ExactFlight", "Adaptive"],
)
@pytest.mark.parametrize("cycles", some([1, 3], 3))  # without an impact, and with three
def test_second_derivatives_pass_through_impacts(method, cycles):
    slope = jax.jit(jax.jacfwd(final(method, cycles)))
    x, h = jnp.array([ZETA, XI, K, GAP, 0.1, 0.2]), 1e-5
    bend = jax.jit(jax.jacfwd(jax.jacfwd(final(method, cycles))))(x)
    difference = [(slope(x + h * e) - slope(x - h * e)) / (2 * h) for e in jnp.eye(6)]
    # The difference's own truncation is h²/6 times the third derivative.
    scale = float(jnp.abs(bend).max())
    np.testing.assert_allclose(bend, jnp.stack(difference, -1), atol=1e-7 * (1 + scale))


@pytest.mark.slow
@pytest.mark.parametrize("extremes", some([False, True], False), ids=["state", "extremes"])
@pytest.mark.parametrize(
    ("method", "order"),
    [
        (vi.ExactFlight(), 3),
        pytest.param(vi.ExactFlight(), 4, marks=pytest.mark.exhaustive),
        pytest.param(vi.FixedStep(steps_per_cycle=24), 3, marks=pytest.mark.exhaustive),
        pytest.param(vi.Taylor(16, 8), 3, marks=pytest.mark.exhaustive),
    ],
    ids=["ExactFlight, third", "ExactFlight, fourth", "FixedStep", "Taylor"],
)
def test_higher_derivatives_pass_through_impacts(method, order, extremes):
    """Along a line through the parameters and the start, beside differences of one order less."""
    at, along = jnp.array([ZETA, XI, K, GAP, 0.1, 0.2]), jnp.array([0.3, 0.2, -0.4, 0.1, 0.5, -0.2])
    functions = [lambda t: final(method, 3, extremes=extremes)(at + t * along)]
    for _ in range(order):
        functions.append(jax.jacfwd(functions[-1]))
    lower, higher = (jax.jit(f) for f in functions[-2:])
    h = 1e-3
    near, far = ((lower(x) - lower(-x)) / (2 * x) for x in (h, 2 * h))
    found = np.asarray(higher(0.0))
    # The difference of fourth order errs by h⁴/30 times a derivative of order + 4.
    np.testing.assert_allclose(found, (4 * near - far) / 3, rtol=1e-6)


@pytest.mark.slow
def test_gradients_are_the_forward_ones():
    """Of a function of two numbers, also under `vmap`, and of second order."""

    def lowest(numbers):
        scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=numbers[0], gap=numbers[1])
        run = vi.simulate(scene, scene.start(), 6, method=vi.ExactFlight(), record="sections")
        return run.last.Y * run.last.V

    at = jnp.asarray([[0.5, 1.0], [0.7, 1.3]])
    gradient = jax.jit(jax.vmap(jax.grad(lowest)))(at)
    forward = jax.jit(jax.vmap(jax.jacfwd(lowest)))(at)
    np.testing.assert_allclose(gradient, forward, rtol=1e-12)
    whole = jax.grad(lambda x: jnp.sum(jax.vmap(lowest)(x)))(at)
    np.testing.assert_allclose(whole, forward, rtol=1e-12)
    shared = jax.grad(lambda k: jnp.sum(jax.vmap(lambda x: lowest(jnp.stack([k, x[1]])))(at)))(0.6)
    apart = [jax.jacfwd(lambda k, x=x: lowest(jnp.stack([k, x[1]])))(0.6) for x in at]
    np.testing.assert_allclose(shared, sum(apart), rtol=1e-12)
    curved = jax.hessian(lowest)(at[0])  # forward over reverse
    np.testing.assert_allclose(curved, jax.jacfwd(jax.jacfwd(lowest))(at[0]), rtol=1e-9)
    np.testing.assert_allclose(curved, jax.jacrev(jax.grad(lowest))(at[0]), rtol=1e-9)
    h = 1e-6 * jnp.eye(2)
    slope = [(lowest(at[0] + e) - lowest(at[0] - e)) / 2e-6 for e in h]
    np.testing.assert_allclose(gradient[0], slope, rtol=1e-6, atol=1e-7)


RECORDED = {
    "ideal": ("ideal", "phase", vi.FixedStep(steps_per_cycle=40)),
    "ideal, exact": ("ideal", "phase", vi.ExactFlight()),
    "ideal, time": ("ideal", "time", vi.FixedStep(steps_per_cycle=40)),
    "motor": ("motor", "phase", vi.FixedStep(steps_per_cycle=40)),
    "motor, time": ("motor", "time", vi.Taylor(rtol=1e-12)),
}


@pytest.mark.parametrize("name", quick(RECORDED, slow=("motor",)))
def test_derivatives_of_all_that_is_recorded(name):
    """States on sections and between them, extremes, times, and the impacts' phases and speeds."""
    kind, clock, method = RECORDED[name]

    def recorded(x):
        xi, k, gap, speed, V, section = x
        drive = vi.Motor(0.6, speed, 0.1, 0.05) if kind == "motor" else vi.IdealDrive(speed)
        stops = (vi.RigidStop(gap, k), vi.RigidStop(1.3 + gap, 0.5 * k, side="left"))
        scene = vi.Scene(
            oscillator=vi.Oscillator(xi), drive=drive, stops=stops, clock_name=clock,
            section_phase=section,
        )  # fmt: skip
        start = scene.start(V=V, W=speed) if kind == "motor" else scene.start(V=V)
        run = vi.simulate(scene, start, 3, method=method, impact_log=6, samples=3)
        log = jax.tree.map(jnp.nan_to_num, (run.impact_log.phase, run.impact_log.speed))
        every = (run.sections, run.samples.state, run.samples.time, run.y_max, run.y_min)
        return (*every, run.impact_speed, *log), run.impacts

    rng = np.random.default_rng(0)
    low, high = np.array([[0.01, 0.3, 0.2, 0.6, -1, -1], [0.1, 0.9, 0.9, 1.2, 1, 1]])
    derivatives = jax.jit(jax.jacfwd(lambda x: recorded(x)[0]))
    values, h = jax.jit(recorded), 1e-6
    for _ in range(4):
        x = jnp.asarray(rng.uniform(low, high))
        found = derivatives(x)
        for i, e in enumerate(h * jnp.eye(6)):
            (above, more), (below, fewer) = values(x + e), values(x - e)
            assert (more == fewer).all() and more.sum() > 0
            for slope, a, b in zip(*map(jax.tree.leaves, (found, above, below)), strict=True):
                wanted = (a - b) / (2 * h)
                scale = 1 + float(jnp.abs(wanted).max())
                np.testing.assert_allclose(slope[..., i], wanted, atol=2e-6 * scale)
