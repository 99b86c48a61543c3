"""The relief valve, a machine whose cycles end with an event."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

VALVE = vi.machines.ReliefValve
CLOSE = vi.Adaptive(rtol=1e-12)


def lanes(flow_rates, starts, cycles, **options):
    def one(q, start):
        valve = VALVE(flow_rate=q)
        return vi.simulate(valve, valve.start(**start), cycles, **options)

    return vi.jit(jax.vmap(one))(jnp.asarray(flow_rates), jax.tree.map(jnp.asarray, starts))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "record"),
    [(vi.Adaptive(), "motion"), (vi.FixedStep(), "sections"), (vi.Taylor(rtol=1e-10), "sections")],
    ids="aft",
)
def test_no_cycle_is_missed(method, record):
    """The section is also a turning point. One event must not hide the other."""
    q = np.linspace(1.6, 5.4, 12)
    start = {"lift": np.ones(12), "speed": np.zeros(12), "pressure": np.full(12, 12.0)}
    run = lanes(q, start, 40, settle=60, method=method, record=record)
    assert bool(run.successful.all())
    # Here each cycle has one impact and equals the one before.
    assert (run.impacts == 1).all()
    np.testing.assert_allclose(run.sections.speed[:, 1:], 0, atol=1e-9)
    if record == "motion":
        np.testing.assert_allclose(np.ptp(run.duration, axis=1), 0, atol=1e-6)


@pytest.mark.slow
def test_a_first_cycle_shorter_than_a_step():
    """The start is a lowest point on the section, close to the next maximum."""
    valve, steps = VALVE(flow_rate=1.6), 6
    for method in (vi.FixedStep(steps_per_cycle=steps), vi.Taylor(20, steps_per_cycle=steps)):
        run = vi.simulate(valve, valve.start(lift=1.0, pressure=12.0), 2, method=method)
        np.testing.assert_allclose(run.duration, [0.0559729, 1.5679299], atol=1e-2 / steps)


def test_a_closed_valve_rests_on_its_seat():
    """The valve stays closed until the pressure p0 + β q t exceeds the preload δ of the spring."""
    valve = VALVE(flow_rate=0.5).observed_every(0.05)
    run = vi.simulate(valve, valve.start(lift=0.0, pressure=4.0), 20, method=CLOSE)
    closed = np.asarray(run.sections.lift) == 0
    np.testing.assert_array_equal(closed[:13], True)
    assert not closed[13:].any()
    np.testing.assert_allclose(run.sections.pressure[:13], 4 + 0.5 * np.arange(13), atol=1e-10)


@pytest.mark.slow
def test_a_valve_observed_at_equal_times():
    valve = VALVE(flow_rate=5.0)
    by_event = vi.simulate(valve, valve.start(), 4, method=CLOSE)
    total = by_event.duration.sum()
    by_time = vi.simulate(valve.observed_every(total), valve.start(), 1, samples=50, method=CLOSE)
    for a, b in zip(*map(jax.tree.leaves, (by_event.last, by_time.last)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    assert int(by_time.impacts.sum()) == int(by_event.impacts.sum())
    with pytest.raises(ValueError, match="`samples` must be 0"):
        vi.simulate(valve, valve.start(), 4, samples=10)
    with pytest.raises(ValueError, match="`interval`"):
        valve.observed_every(0.0)
    with pytest.raises(ValueError, match="driven"):
        vi.machines.Duffing().observed_every(1.0)
