"""Compare the outcome of a grazing with closed forms, published windows and SciPy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from vi_jax.orbit.forecast import find_attractors
from vi_jax.orbit.local_map import graze_at

from grazings import grazing_of

pytestmark = pytest.mark.slow

K = 0.8


def overdamped(share):
    """Return x'' + 10.1 x' + x = cos ωt with `share` as its slower multiplier, its frequency, and
    the amplitude of its motion without impacts."""
    frequency = 0.2 * np.pi / np.log(1 / share)
    amplitude = 1 / np.hypot(1 - frequency**2, 10.1 * frequency)
    machine = vi.machines.Duffing(
        amplitude=1.0, frequency=frequency, damping=10.1, gap=1.1 * amplitude, restitution=K,
        two_sided=False,
    )  # fmt: skip
    return machine, frequency, amplitude


@pytest.fixture(scope="module")
def half():
    machine, frequency, amplitude = overdamped(0.5)
    point = grazing_of(machine, "gap", (0.9 * amplitude, 1.2 * amplitude))
    return point, vi.grazing(point), frequency, amplitude


def test_local_map_agrees_with_the_closed_form(half):
    _, found, frequency, amplitude = half
    assert found.value == pytest.approx(amplitude, rel=1e-12)
    field = np.array([[0.0, 1.0], [-1.0, -10.1]])
    np.testing.assert_allclose(found.matrix, expm(field * 2 * np.pi / frequency), atol=1e-12)
    np.testing.assert_allclose(np.sort(np.abs(found.multipliers)), [0, 0.5], atol=1e-12)
    # With respect to the phase, h = gap - amplitude·cos and dh/ds = -V/ω.
    assert found.rate[0] == pytest.approx(amplitude, rel=1e-11)
    np.testing.assert_allclose(found.gradient, [[-1, 0]], atol=1e-15)
    jump = -np.sqrt(2 * amplitude) * (1 + K) * frequency
    np.testing.assert_allclose(found.kick, [[0, jump]], rtol=1e-10, atol=1e-15)
    assert found.slope[0] == pytest.approx(1, abs=1e-10) and found.side == -1
    e = [-(expm(field * 2 * np.pi * n / frequency) @ [0, jump])[0] for n in range(1, 13)]
    np.testing.assert_allclose(found.entries, e, atol=1e-13)


def test_periods_after_a_grazing(half):
    """Windows of motions with one impact have chaos between them (`scans/test_regimes.py`; Chin,
    Ott, Nusse and Grebogi, Phys. Rev. E 50, 1994)."""
    point, found, _, amplitude = half
    beyond = {4.0e-6: 7, 1.5e-5: 6, 3.5e-5: 0, 8.4e-5: 5}
    offsets = amplitude / (1 + np.array([*beyond])) - amplitude
    forecast = find_attractors(graze_at(point).map, offsets)
    assert forecast.period.tolist() == [*beyond.values()]
    assert found.outcome == vi.SCENARIOS.period_adding_with_chaos
    for offset, period, impacts in zip(offsets, forecast.period, forecast.impacts, strict=True):
        if period:
            near, far = found.windows.stable[period - 1]
            assert impacts == 1 and far < offset < near


def fly(field, hit, s0, s1, x):
    """Integrate by SciPy with the guard and the jump in `hit`, or without a stop if `None`."""
    options = {"rtol": 1e-12, "atol": 1e-14, "max_step": 0.02}
    while True:
        events = None if hit is None else hit[0]
        run = solve_ivp(field, (s0, s1), x, events=events, **options)
        if hit is None or run.status == 0:
            return run.y[:, -1]
        s0, x = run.t[-1], hit[1](run.y[:, -1])


def test_error_of_the_discontinuity_mapping():
    """An impact changes the state at order y; the mapping has an error of order y²."""
    machine = vi.machines.Duffing(
        amplitude=0.5, frequency=0.9, damping=0.6, cubic=0.4, gap=1.5, restitution=K,
        two_sided=False,
    )  # fmt: skip
    graze = graze_at(grazing_of(machine, "gap", (0.1, 2.0)))
    (touch,) = graze.touches
    gap = graze.x[-1]

    def field(s, x):
        push = 0.5 * np.cos(s) - 0.6 * x[1] - x[0] - 0.4 * x[0] ** 3
        return np.array([x[1], push]) / 0.9

    def beyond(s, x):
        return x[0] - gap

    beyond.terminal, beyond.direction = True, 1
    hit = beyond, lambda x: np.array([x[0] - 1e-15, -K * x[1]])
    depths, errors = 0.02 / 2.0 ** np.arange(4), []
    for y in depths:
        deep = touch.state - y**2 * touch.gradient / (touch.gradient @ touch.gradient)
        before = fly(field, None, touch.clock, touch.clock - 0.5, deep)
        free = fly(field, None, touch.clock, touch.clock + 0.5, deep)
        struck = fly(field, hit, touch.clock - 0.5, touch.clock + 0.5, before)
        kicked = fly(field, None, touch.clock, touch.clock + 0.5, deep + y * touch.kick.vector)
        errors.append(np.abs(struck - kicked).max())
        assert np.abs(struck - free).max() > 10 * errors[-1]
    slopes = np.diff(np.log(errors)) / np.diff(np.log(depths))
    np.testing.assert_allclose(slopes, 2, atol=0.1)


def test_grazing_of_the_paper():
    """The 2π motion of the paper is lost at BB'. Since e₁ > 0 > e₂, an impact brings the body
    nearer to the stop two periods later, and there is no attractor near."""
    restitution, damping, zeta = 0.5, 0.04483682577, 0.70998
    scene = vi.Scene.ideal(frequency_ratio=0.8, restitution=restitution, damping_ratio=damping)
    closed = vi.closed_form_orbits(scene)
    start = scene.start(Y=closed.Y[0], V=closed.V[0])
    point = grazing_of(scene, "drive.frequency_ratio", (0.5, 1.9), start)
    found = vi.grazing(point)
    assert found.value == pytest.approx(zeta, abs=1e-5) and found.side == 1
    rate, turn = np.sqrt(1 - damping**2), 2 * np.pi / found.value
    n = np.arange(1, 13)
    e = np.exp(-damping * turn * n) * np.sin(rate * turn * n) / rate
    e = e * np.sqrt(2 * 2.0) * (1 + restitution) * found.value
    np.testing.assert_allclose(found.entries, e, rtol=1e-8, atol=1e-8)
    assert found.entries[0] > 0 > found.entries[1]
    assert found.outcome == vi.SCENARIOS.jump
    assert found.checked[1] > 1e3 * found.checked[0] and found.agreement == 1
    # The plot shows the distant motion of the machine or, without a check, no attractor.
    labels = [text.get_text() for text in vi.plot_grazing(found).get_legend().get_texts()]
    assert labels == [f"the machine, far away: {found.distant_in_words}", "grazing"]
    ax = vi.plot_grazing(dataclasses.replace(found, machine=None, far=None))
    assert [text.get_text() for text in ax.texts] == ["forecast: no attractor near"]


def test_two_stops_are_touched_at_once():
    """A symmetric motion grazes both stops, half a period apart."""
    machine = vi.machines.Duffing(amplitude=0.3, frequency=0.7, damping=0.4, gap=1.0)
    found = vi.grazing(grazing_of(machine, "gap", (0.3, 1.2)))
    assert found.kick.shape == (2, 2) and found.touched == "left stop and the right stop"
    field = np.array([[0.0, 1.0], [-1.0, -0.4]])
    np.testing.assert_allclose(found.matrix, expm(field * 2 * np.pi / 0.7), atol=1e-10)
    assert found.checked is not None and found.windows is None


class Soft(vi.Mechanical):
    """A driven body with a soft stop."""

    q, mass, cycle = ("x",), (1.0,), 2 * jnp.pi
    stop: vi.SoftStop
    push: float = 1.0

    @property
    def contacts(self):
        return self.stop

    def force(self, t, q, v):
        return dict(x=self.push * jnp.cos(t) - 0.5 * q.x - 0.4 * v.x)


SWING = 1 / np.hypot(0.5, 0.4)


def soft_grazing(stiffness=30.0, **options):
    machine = Soft(vi.SoftStop(1.1 * SWING, stiffness, **options))
    return grazing_of(machine, "stop.gap", (0.9 * SWING, 1.2 * SWING))


def test_orders_and_kicks_of_soft_stops():
    """Over a parabola of depth, a spring of stiffness K gives the impulse K (4/3) √(2/a) y³. At a
    prestress F0 the field jumps, and the body turns back with the acceleration a + F0. A dashpot
    that cannot pull gives an impulse of order y². A contact that is less deep than rounding is
    refused: regression, 5 % off at 1e9, and a damped one of another order."""
    for stiffness in (1e9, 30.0):
        found = vi.grazing(soft_grazing(stiffness), check=False)
        assert found.order[0] == 1.5 and found.rate[0] == pytest.approx(SWING, rel=1e-9)
        impulse = -stiffness * 4 / 3 * np.sqrt(2 / SWING)
        np.testing.assert_allclose(found.kick[0], [0, impulse], rtol=2e-3, atol=2e-3 * -impulse)
    assert found.outcome == vi.SCENARIOS.persistence
    for stiffness, damping in ((1e10, 0.0), (1e9, 0.6)):
        with pytest.raises(ValueError, match=r"a stop that is less stiff: .* Take a `RigidStop`"):
            vi.grazing(soft_grazing(stiffness, damping=damping), check=False)
    found = vi.grazing(soft_grazing(prestress=2.0))
    assert found.order[0] == 0.5
    kick = -2 * 2.0 * np.sqrt(2 * SWING) / (SWING + 2.0)
    np.testing.assert_allclose(found.kick[0], [0, kick], rtol=1e-8, atol=1e-12)
    assert found.checked is not None and found.agreement > 0.9
    assert graze_at(soft_grazing(restitution=0.6, adhesive=False)).touches[0].kick.order == 1


def test_grazings_from_the_side_of_contact():
    """Touch and release vanish together. Compare the push with that of the linear oscillator."""
    machine, bounds = Soft(vi.SoftStop(1.0, 20.0, restitution=0.8), 0.9), ((0.2, 1.0), (0.5, 1.5))
    start = vi.simulate(machine, machine.start(), 1, settle=200).last
    point = grazing_of(machine, "push", bounds[0], start)
    curve = vi.boundary(point, parameter="stop.gap", bounds=bounds)
    assert point.impact is not None and curve.ends == ("bounds", "bounds")
    np.testing.assert_allclose(*(curve.parameters / [1.0, SWING]).T, rtol=1e-12)
