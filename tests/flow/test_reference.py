"""Whole runs beside references that share no code with the package: NumPy, SciPy, the equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.linalg import expm

CYCLES, FINE = 20, 400


def generator(zeta, xi):
    """d/dτ of (Y, V, cos φ, sin φ) is this matrix times it, between impacts."""
    matrix = np.zeros((*np.shape(zeta), 4, 4))
    matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1] = 1.0, -1.0, -2 * xi
    matrix[..., 1, 2], matrix[..., 2, 3], matrix[..., 3, 2] = 1.0, -zeta, zeta
    return matrix


def by_matrix_exponentials(zeta, xi, k, d, Y, V):
    """Sections and impacts per cycle, in 400 fine steps a cycle; impact times by halving."""
    matrix = generator(zeta, xi)
    dt = 2 * np.pi / zeta / FINE
    step = expm(matrix * dt[:, None, None])
    z = np.stack([Y, V, np.ones_like(Y), np.zeros_like(Y)], -1)
    impacts, sections = np.zeros((len(zeta), CYCLES), int), [z[:, :2]]
    for cycle in range(CYCLES):
        for i in range(FINE):
            # The drive is known; carrying it along would gather rounding.
            z[:, 2:] = np.cos(2 * np.pi * i / FINE), np.sin(2 * np.pi * i / FINE)
            new = np.einsum("nij,nj->ni", step, z)
            for lane in np.nonzero(new[:, 0] > d)[0]:
                rest, end = dt[lane], z[lane]
                while (beyond := expm(matrix[lane] * rest) @ end)[0] > d[lane]:
                    passed = 0.0
                    for j in range(1, 52):
                        inside = expm(matrix[lane] * rest / 2**j) @ end
                        if inside[0] <= d[lane]:
                            end, passed = inside, passed + rest / 2**j
                    end = np.array([d[lane], -k[lane] * end[1], *end[2:]])
                    rest -= passed
                    impacts[lane, cycle] += 1
                new[lane] = beyond
            z = new
        sections.append(z[:, :2])
    return np.stack(sections, 1), impacts


def lanes(method, scenes):
    def lane(zeta, xi, k, d, Y, V):
        scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=d, damping_ratio=xi)
        return vi.simulate(scene, scene.start(Y=Y, V=V), CYCLES, method=method, impact_log=12)

    run = vi.jit(jax.vmap(lane))(*map(jnp.asarray, scenes))
    return run, np.stack([run.sections.Y, run.sections.V], -1)


@pytest.mark.slow
def test_impacting_lanes_by_matrix_exponentials():
    """Damping is light here, so that most lanes go on impacting and some amplify errors."""
    draw = np.random.default_rng(5).uniform
    low, high = [0.3, 0.0, 0.05, 1.05, -1.0, -2.0], [2.0, 0.08, 0.95, 3.0, 1.0, 2.0]
    scenes = [draw(a, b, 600) for a, b in zip(low, high, strict=True)]
    scenes[1][:120] = 0.0
    truth, impacts = by_matrix_exponentials(*scenes)
    assert (impacts.sum(1) > 0).mean() > 0.6 and impacts.sum() > 4000
    run, exact = lanes(vi.ExactFlight(), scenes)
    shift = np.zeros(600)
    for place in (4, 5):
        moved = [x + 1e-10 * (i == place) for i, x in enumerate(scenes)]
        shift = np.maximum(shift, np.abs(lanes(vi.ExactFlight(), moved)[1] - exact).max((1, 2)))
    slowest = np.where(run.impact_log.stop < 0, np.inf, run.impact_log.speed).min((1, 2))
    kept = (slowest >= 1e-3) & (shift <= 1e-4)  # neither grazing nor chaotic
    assert kept.mean() > 0.99
    np.testing.assert_array_equal(np.asarray(run.impacts)[kept], impacts[kept])
    # The reference gathers rounding over 8,000 steps, about 1e-12, and a lane amplifies it as it
    # amplifies the perturbation of 1e-10.
    assert (np.abs(exact - truth).max((1, 2)) <= 1e-11 + 0.1 * shift)[kept].all()
    steps, adaptive = lanes(vi.Adaptive(rtol=1e-10), scenes)
    np.testing.assert_array_equal(np.asarray(steps.impacts)[kept], impacts[kept])
    # Some 300 steps may each err by rtol (1 + |state|), about 3e-10: amplified as the perturbation
    # of 1e-10 is, that makes 900 shifts if all add up; 50 are the most of 3,000 lanes measured.
    assert (np.abs(adaptive - truth).max((1, 2)) <= 1e-7 + 100 * shift)[kept].all()


def test_free_flight_over_cycles():
    """No stop: under-, critically and over-damped, and both sides of the switch at resonance."""
    near = [0.0, 1e-6, -1e-6, 1e-3, -1e-3, 9e-3, -9e-3, 1.1e-2, -1.1e-2]
    zeta, xi = map(np.ravel, np.meshgrid([0.3, 2.7, *(1 + np.array(near))], [0.0, 0.3, 1.0, 1.5]))

    def lane(zeta, xi):
        scene = vi.Scene.ideal(frequency_ratio=zeta, gap=None, damping_ratio=xi)
        return vi.simulate(scene, scene.start(Y=0.7, V=-0.4), 10, method=vi.ExactFlight()).sections

    found = jax.jit(jax.vmap(lane))(jnp.asarray(zeta), jnp.asarray(xi))
    found = np.stack([found.Y, found.V], -1)
    for n in range(11):
        time = 2 * np.pi * n / zeta
        whole = expm(generator(zeta, xi) * time[:, None, None]) @ [0.7, -0.4, 1.0, 0.0]
        np.testing.assert_allclose(found[:, n], whole[:, :2], atol=1e-11)


def slide(phase, ratio):
    """U, U', U'' of the slider, differentiated by hand; `ratio=None` is the cosine."""
    c, s = np.cos(phase), np.sin(phase)
    if ratio is None:
        return c, -s, -c
    root = np.sqrt(1 - ratio**2 * s * s)
    bend = (c * c - s * s) / root + ratio**2 * s * s * c * c / root**3
    return c + (root - 1) / ratio, -s - ratio * s * c / root, -c - ratio * bend


def motor_by_scipy(torque, kappa, d, k, ratio, start, cycles):
    """Table 1's machine from the equations of motion, in time, with SciPy's events."""
    omega2 = 9 * np.pi**2 / 0.35
    xi, mu, eps = 0.5 / (2 * 0.35 * np.sqrt(omega2)), 0.2 * 0.0016 / 0.06, 0.35 * 0.0016 / 0.06

    def field(t, x):
        U, U1, U2 = slide(x[3], ratio)
        drive = torque / (0.06 * omega2) * (kappa - x[2])
        shaft = drive + eps * U1 * (x[0] - U) - mu * U1 * U2 * x[2] ** 2
        return [x[1], U - x[0] - 2 * xi * x[1], shaft / (1 + mu * U1**2), x[2]]

    def stop(t, x):
        return x[0] - d

    x, t, sections, times, impacts = np.array([*start, 0.0]), 0.0, [start], [0.0], []
    for cycle in range(1, cycles + 1):

        def section(t, x, turn=2 * np.pi * cycle):
            return x[3] - turn

        stop.terminal = section.terminal = True
        stop.direction = section.direction = 1
        impacts.append(0)
        while True:
            leg = solve_ivp(
                field, (t, t + 100), x, "DOP853", rtol=1e-12, atol=1e-13,
                events=[stop, section], max_step=0.3,
            )  # fmt: skip
            t, x = leg.t[-1], leg.y[:, -1].copy()
            if not len(leg.t_events[0]):
                break
            x[0], x[1] = d, -k * x[1]
            impacts[-1] += 1
        sections.append(x[:3])
        times.append(t)
    return np.array(sections), np.diff(times), impacts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crank", "torque", "kappa", "d", "k"),
    [("cosine", 2.0, 0.9, 2.0, 0.5), ("slider", 2.0, 0.9, 2.0, 0.5), ("slider", 10.0, 0.7, 1.1, 0)],
)
def test_motor_by_scipy(crank, torque, kappa, d, k):
    scene = vi.Parameters(torque=torque, control=kappa, restitution=k, gap=0.04 * d).scene(
        crank=crank
    )
    ratio = 1 / 3 if crank == "slider" else None
    truth, durations, impacts = motor_by_scipy(torque, kappa, d, k, ratio, (0.3, 0.2, 0.8), 15)
    assert sum(impacts) >= 14
    for clock in ("phase", "time"):
        start, method = scene.start(Y=0.3, V=0.2, W=0.8), vi.Adaptive(rtol=1e-12)
        run = vi.simulate(scene, start, 15, method=method, clock=clock)
        found = np.stack([run.sections.Y, run.sections.V, run.sections.W], -1)
        np.testing.assert_allclose(found, truth, atol=1e-10)
        np.testing.assert_allclose(run.duration, durations, atol=1e-11)
        np.testing.assert_array_equal(run.impacts, impacts)
