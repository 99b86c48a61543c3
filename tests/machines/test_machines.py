"""Ready machines: closed forms of their motions, and an independent integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from event_by_event import followed

PI = np.pi
BALL, PAIR, DUFFING = vi.machines.BouncingBall, vi.machines.ImpactPair, vi.machines.Duffing
FREE = PAIR(half_gap=1.0, mass_ratio=0.2, damping_ratio=0.1, force=0.6)
SOFTENING = DUFFING(amplitude=0.4, cubic=0.5, stiffness=0.5, frequency=0.9)


def sigma(e):
    return (1 - e) / (1 + e)


@pytest.fixture(scope="module")
def restitution():
    return 0.5


@pytest.fixture(scope="module")
def bounces(restitution):
    """The branch of one bounce a cycle, found from its closed form."""
    w, e = PI * sigma(restitution), restitution
    table = 1.3 * w
    # The ball leaves where it meets: a flight of 2π needs the table's speed Γ sin s to be w.
    at = PI - np.arcsin(w / table)
    left, since = e * (PI + w), 2 * PI - at
    ball = BALL(acceleration=table, restitution=e)
    start = ball.start(
        height=left * since - since**2 / 2 + table * (1 - np.cos(at) + np.sin(at) * since),
        speed=left - since + table * np.sin(at),
    )
    orbit = vi.find_orbit(ball, start, throw=True)
    assert float(orbit.impact_speed[0]) == pytest.approx(PI + w, abs=1e-10)
    assert float(orbit.impact_phase[0]) == pytest.approx(at, abs=1e-10)
    return vi.continue_orbit(orbit, parameter="acceleration", bounds=(0.05, 2.0))


@pytest.mark.slow
def test_a_bounce_is_born_and_doubles_where_its_closed_form_does(bounces, restitution):
    e, born = restitution, PI * sigma(restitution)
    (fold,) = (p for p in bounces.special if p.kind == "fold")
    (doubling,) = (p for p in bounces.special if p.kind == "period-doubling")
    assert fold.parameter == pytest.approx(born, abs=1e-9)
    doubles = np.hypot(born, 2 * (1 + e**2) / (1 + e) ** 2)
    assert doubling.parameter == pytest.approx(doubles, abs=1e-9)
    assert doubles == pytest.approx(1.5268237005, abs=1e-10)


@pytest.mark.slow
def test_a_bounce_of_twice_the_period(bounces):
    doubling = next(p for p in bounces.special if p.kind == "period-doubling")
    twice = doubling.switch()
    assert int(twice.cycles) == 2 and int(twice.impacts) == 2 and "2 cycles" in str(twice)
    run = vi.simulate(twice.machine, twice.state, 4, method="reference")
    np.testing.assert_allclose(run.sections.height[2:], run.sections.height[:-2], atol=1e-9)


@pytest.fixture(scope="module")
def symmetric(restitution):
    """The branch of the symmetric motion, found from its closed form at λ = 2."""
    e, half = restitution, 2.0
    a, b, c = PI**2 / 4 + sigma(e) ** 2, -PI * half, half**2 - 1
    w = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
    pair = PAIR(half_gap=half, restitution=e)
    # It meets the left wall where that is at sin s = λ - πw/2, and flies to the right at speed w.
    at = np.mod(np.arctan2(half - PI * w / 2, sigma(e) * w), 2 * PI)
    place, speed = -half + np.sin(at) + w * (2 * PI - at), w
    if at < PI:  # by the section it is on its way back
        place, speed = half - np.sin(at) - w * (PI - at), -w
    orbit = vi.find_orbit(pair, pair.start(place=place, speed=speed - 1), throw=True)
    np.testing.assert_allclose(orbit.impact_speed, 2 * w / (1 + e), atol=1e-10)
    return vi.continue_orbit(orbit, parameter="half_gap", bounds=(1.05, 20.0))


@pytest.mark.slow
def test_an_impact_pair_folds_and_loses_its_symmetry(symmetric, restitution):
    special = {p.kind: p.parameter for p in symmetric.special}
    s = sigma(restitution)
    assert special["fold"] == pytest.approx(np.sqrt(1 + PI**2 / (4 * s * s)), abs=1e-9)
    breaks = (PI / 2 - 2 / PI) / np.sqrt(4 / PI**2 + s * s)
    assert special["symmetry-breaking"] == pytest.approx(breaks, abs=1e-9)
    assert breaks == pytest.approx(1.2999827618, abs=1e-10)


@pytest.mark.slow
def test_the_broken_symmetry_is_switched_onto(symmetric, restitution):
    breaking = next(p for p in symmetric.special if p.kind == "symmetry-breaking")
    broken = vi.continue_orbit(breaking.switch(), parameter="half_gap", bounds=(1.25, 1.5))
    # It ends where it springs: beyond, there are the images of its motions.
    assert "symmetry-breaking" in broken.ends
    (spring,) = (p for p in broken.special if p.kind == "symmetry-breaking")
    assert "fold" not in {p.kind for p in broken.special}
    assert spring.parameter == pytest.approx(breaking.parameter, abs=1e-9)
    # Speeds of both flights as simulated independently (six digits).
    for orbit in broken.at(1.28):
        flights = np.abs(
            np.cos(orbit.impact_phase)
            - np.where(np.asarray(orbit.impact_stop) == 0, 1, -1) * 0.5 * orbit.impact_speed
        )
        np.testing.assert_allclose(np.sort(flights), [1.25268, 1.51569], atol=6e-6)
        assert bool(orbit.stable)
    (whole,) = (orbit for orbit in symmetric.at(1.32) if orbit.stable)
    np.testing.assert_allclose(whole.impact_speed, 1.87073, atol=6e-6)


@pytest.mark.slow
@pytest.mark.parametrize("whole", [True, False], ids=["symmetric", "broken"])
def test_a_curve_of_lost_symmetry_is_its_closed_form(symmetric, whole, restitution):
    branch, ends = symmetric, (1.2, 1.5)
    point = next(p for p in branch.special if p.kind == "symmetry-breaking")
    if not whole:
        branch = vi.continue_orbit(point.switch(), parameter="half_gap", bounds=ends)
        point = next(p for p in branch.special if p.kind == "symmetry-breaking")
    curve = vi.boundary(point, parameter="restitution", bounds=(ends, (0.3, 0.9)))
    half, e = curve.parameters.T
    breaks = (PI / 2 - 2 / PI) / np.sqrt(4 / PI**2 + sigma(e) ** 2)
    np.testing.assert_allclose(half, breaks, atol=1e-12)
    assert np.ptp(e) > 0.4 and curve.kind == "symmetry-breaking"


def flown(machine, start, cycles):
    """State and impacts by SciPy's DOP853 and the machine's laws, written out again here."""

    def rate(t, x):
        if isinstance(machine, BALL):
            return [x[1], -1 - float(machine.acceleration) * np.cos(t)]
        if isinstance(machine, DUFFING):
            w = float(machine.frequency)
            force = float(machine.amplitude) * np.cos(t) - float(machine.damping) * x[1]
            force -= float(machine.stiffness) * x[0] + float(machine.cubic) * x[0] ** 3
            return [x[1] / w, force / w]
        if machine.mass_ratio is None:
            return [x[1], np.sin(t)]
        w, xi = float(machine.frequency), float(machine.damping_ratio)
        box = float(machine.force) * np.sin(t) - w * w * x[2] - 2 * xi * w * x[3]
        return [x[1], -box, x[3], box]

    gap, sides, e = 0.0, (-1,), float(machine.restitution)
    if not isinstance(machine, BALL):
        gap = float(machine.gap if isinstance(machine, DUFFING) else machine.half_gap)
        sides = (1, -1)
    hits = []

    def hit(sign):
        def jump(t, x):
            hits.append(t)
            gained = -(1 + e) * x[1]
            if getattr(machine, "mass_ratio", None) is not None:
                # The ball's and the box's momentum: m (x' + X') + M X' is kept.
                share = float(machine.mass_ratio) / (1 + float(machine.mass_ratio))
                x[3] -= share * gained
            x[:2] = sign * gap, x[1] + gained
            return x if len(hits) <= 60 else None  # it comes to rest, of which this knows nothing

        return jump

    events = [(lambda t, x, sign=sign: sign * x[0] - gap, hit(sign)) for sign in sides]
    end = 2 * PI * cycles
    t, x, met = followed(rate, start, end, events, atol=1e-13)
    return (x if t > end - 1e-12 else None), len(met)


MACHINES = {
    "ball": BALL(acceleration=3.0, restitution=0.6),
    "pair": PAIR(half_gap=1.3, restitution=0.6),
    "free pair": FREE,
    "duffing": SOFTENING,
}


def starts_of(machine, number=12):
    draw = np.random.default_rng(5).uniform
    if isinstance(machine, BALL):
        return [machine.start(height=h, speed=v) for h, v in draw((0.5, -1), (3, 1), (number, 2))]
    if isinstance(machine, DUFFING):
        return [machine.start(Y=y, V=v) for y, v in draw(-0.9, 0.9, (number, 2))]
    return [machine.start(place=y, speed=v) for y, v in draw(-0.9, 0.9, (number, 2))]


@pytest.mark.slow
@pytest.mark.parametrize("name", MACHINES)
def test_a_machine_beside_scipy(name):
    machine, cycles = MACHINES[name], 3
    starts = starts_of(machine)
    batch = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    run = vi.jit(jax.vmap(lambda x: vi.simulate(machine, x, cycles, method="reference")))(batch)
    assert bool(run.successful.all())
    several = compared = 0
    for i, start in enumerate(starts):
        wanted, impacts = flown(machine, jax.tree.leaves(start), cycles)
        if wanted is None:
            assert int(run.rests[i].sum()) > 0
            continue
        found = np.array([x[i, -1] for x in jax.tree.leaves(run.sections)])
        np.testing.assert_allclose(found, wanted, atol=2e-8)
        assert int(run.impacts[i].sum()) == impacts
        several, compared = several + impacts, compared + 1
    assert several > 20 and compared > 6


def test_momentum_and_energy_of_a_free_box():
    """No force, no damping, no spring: both are kept but for what the impacts take."""
    alone = PAIR(half_gap=1.0, mass_ratio=0.3, restitution=0.7, frequency=0.0, force=0.0)
    start = alone.start(speed=1.0, box_speed=0.25)
    run = vi.simulate(alone, start, 8, impact_log=4)
    last, m = run.last, 0.3
    assert int(run.impacts.sum()) >= 6

    def momentum(state):
        return m * (state.speed + state.box_speed) + state.box_speed

    def energy(state):
        return 0.5 * m * (state.speed + state.box_speed) ** 2 + 0.5 * state.box_speed**2

    assert float(momentum(last)) == pytest.approx(float(momentum(start)), abs=1e-15)
    lost = 0.5 * m / (1 + m) * (1 - 0.7**2) * np.nansum(np.asarray(run.impact_log.speed) ** 2)
    assert float(energy(start) - energy(last)) == pytest.approx(lost, abs=1e-13)
    assert float(run.impact_energy.sum()) == pytest.approx(lost, abs=1e-13)
