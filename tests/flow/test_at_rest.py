"""Motions that begin or end at rest on a surface, rigid or soft, with no force there yet."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.integrate import solve_ivp


class Body(vi.AbstractMachine):
    """A body of mass one under a force a + b s + c sin s, with drag."""

    force: Any = eqx.field(converter=lambda x: jnp.asarray(x, float))
    stops: tuple[vi.RigidStop, ...] = ()
    soft: tuple[vi.SoftStop, ...] = ()
    drag: Any = eqx.field(default=0.0, converter=lambda x: jnp.asarray(x, float))

    @property
    def switches(self):
        return self.soft

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, state, *modes):
        a, b, c = self.force
        pull = a + b * s + c * jnp.sin(s) - self.drag * state.V
        for stop, mode in zip(self.soft, modes, strict=True):
            pull = pull + stop.contribution(self, s, state, mode)
        return vi.OscillatorState(state.V, pull)


def at(Y, V):
    return vi.OscillatorState(jnp.asarray(float(Y)), jnp.asarray(float(V)))


def test_a_soft_stop_touched_at_rest():
    """Pressed, about to be, and pulled."""
    forces = np.repeat([(1.0, 0, 0), (0, 0, 1.0), (-1.0, 0, 0)], 2, axis=0)
    gaps = np.tile([0.0, 1e-12], 3)

    def one(force, gap):
        spring = vi.SoftStop(gap, 50.0, restitution=0.6)
        return vi.simulate(Body(force, soft=(spring,), drag=0.1), at(0, 0), 1)

    run = jax.vmap(one)(jnp.asarray(forces), jnp.asarray(gaps))
    assert bool(run.successful.all())
    damper = float(vi.SoftStop(0.0, 50.0, restitution=0.6).damping) * np.sqrt(50.0)
    for i, ((a, b, c), gap) in enumerate(zip(forces, gaps, strict=True)):

        def rate(s, x, a=a, b=b, c=c, gap=gap):
            push = 50 * (x[0] - gap) + damper * x[1] if x[0] > gap else 0.0
            return x[1], a + b * s + c * np.sin(s) - 0.1 * x[1] - push

        truth = solve_ivp(rate, (0, 2 * np.pi), (0, 0), rtol=1e-11, atol=1e-13, max_step=1e-2)
        np.testing.assert_allclose([run.last.Y[i], run.last.V[i]], truth.y[:, -1], atol=1e-6)


def test_a_body_rests_while_the_force_that_will_press_it_on_grows():
    """Under sin s it is held for half a cycle, and leaves then."""

    def one(restitution):
        body = Body(jnp.asarray((0, 0, 1.0)), (vi.RigidStop(0.0, restitution),))
        return vi.simulate(body, at(0, 0), 1, event_log=4)

    run = jax.vmap(one)(jnp.array([0.0, 0.3, 0.8]))
    assert bool(run.successful.all()) and int(run.impacts.sum()) == 0
    np.testing.assert_allclose(run.last.Y, -np.pi, atol=1e-9)
    np.testing.assert_allclose(run.last.V, -2.0, atol=1e-9)
    assert (run.event_log.kind[:, 0, 0] == vi.EVENTS.index("release")).all()
    np.testing.assert_allclose(run.event_log.phase[:, 0, 0], np.pi, atol=1e-9)


def test_an_impact_without_restitution_as_the_force_turns():
    """The force is s - 1, the body meets the stop at s = 1: there it stays, by one impact."""
    speed, place = 0.5 + 0.5, -(0.5 - 1 / 3) - 0.5  # at s = 0, so that it is 0.5 and 0 at s = 1
    body = Body(jnp.asarray((-1.0, 1.0, 0)), (vi.RigidStop(0.0, 0.0),))
    run = vi.simulate(body, at(place, speed), 1, impact_log=4)
    assert bool(run.successful) and int(run.impacts[0]) == 1 and int(run.rests[0]) == 1
    np.testing.assert_allclose(run.impact_log.speed[0, 0], 0.5, rtol=1e-9)
    assert float(run.last.Y) == 0.0 and float(run.last.V) == 0.0


def test_every_event_is_logged_in_its_order():
    """A ball pressed for half of each cycle on a stop and let go of; without the log, the same."""
    body = Body(jnp.asarray((0.3, 0, 1.0)), (vi.RigidStop(0.0, 0.4),), drag=0.1)
    plain = vi.simulate(body, at(-0.2, 0), 4, impact_log=40)
    run = vi.simulate(body, at(-0.2, 0), 4, impact_log=40, event_log=60)
    split = vi.simulate(body, at(-0.2, 0), 4, samples=7, event_log=60)
    log = run.event_log
    kinds = np.asarray(log.kind)
    for i in range(4):
        count, hits = int(plain.impacts[i]), kinds[i] == 0
        assert hits.sum() == count and (kinds[i] == 1).sum() == run.rests[i]
        np.testing.assert_array_equal(log.phase[i, hits], plain.impact_log.phase[i, :count])
        np.testing.assert_array_equal(log.value[i, hits], plain.impact_log.speed[i, :count])
        used = kinds[i] >= 0
        assert (np.diff(log.phase[i, used]) >= 0).all() and used.argmin() == used.sum()
    # It leaves where the force turns: sin s = -0.3.
    leaves = np.asarray(log.phase)[kinds == 2]
    assert run.rests.sum() == len(leaves) > 1
    np.testing.assert_allclose(leaves, np.pi + np.arcsin(0.3), atol=1e-9)
    assert (np.asarray(log.number)[kinds >= 0] == 0).all()
    table = run.to_xarray(along="event").to_dataframe()
    assert table.event_kind.tolist() == [vi.EVENTS[k] for k in kinds[kinds >= 0]]
    assert (table.cycle == 1 + np.nonzero(kinds >= 0)[0]).all()
    np.testing.assert_array_equal(split.event_log.kind, kinds)
    np.testing.assert_allclose(split.event_log.phase, log.phase, atol=1e-7)
