"""Machines with delays beside exact values, and beside SciPy by the method of steps."""

import functools
import importlib
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax import lanes

from delayed import Masses, Struck, Turning, by_steps, struck_by_steps


class Linear(vi.AbstractMachine):
    """x' = -x(t - 1) after x = 1: a polynomial in each unit of time."""

    cycle = 5.0
    delays = property(lambda self: dict(lag=1.0))

    def field(self, t, z, past):
        return dict(x=-past.lag.x)

    def start(self):
        return vi.State(x=1.0)


class Two(Struck):
    """Two delays, one of a velocity, and a history that is a function."""

    slow: float = 0.1
    near: float = 1.0
    delays = property(lambda self: dict(far=self.delay, near=self.near))

    def before(self, t):
        return dict(x=0.2 * jnp.cos(1.3 * t), u=-0.26 * jnp.sin(1.3 * t))

    def field(self, t, z, past):
        pull = self.gain * (past.far.x - z.x) + self.slow * (past.near.u - z.u)
        return dict(x=z.u, u=jnp.cos(self.omega * t) - z.x - 2 * self.damping * z.u + pull)

    def start(self):
        return vi.State(x=0.2, u=0.0)


CYCLES = 6


def two_by_steps(m):
    """Return the same motion by SciPy, for parameters in a dictionary."""

    def rate(t, y, past):
        pull = m["gain"] * (past[0][0] - y[0]) + m["slow"] * (past[1][1] - y[1])
        return [y[1], np.cos(m["omega"] * t) - y[0] - 2 * m["damping"] * y[1] + pull]

    return by_steps(
        rate, [0.2, 0.0], lambda t: [0.2 * np.cos(1.3 * t), -0.26 * np.sin(1.3 * t)],
        [m["delay"], m["near"]], CYCLES * 2 * np.pi / m["omega"],
        guard=lambda t, y, past: y[0] - m["gap"],
        jump=lambda y, past: [m["gap"], -m["restitution"] * y[1]],
    )  # fmt: skip


def random_machines(number, seed):
    rng = np.random.default_rng(seed)
    ranges = dict(
        omega=(0.6, 1.6), damping=(0.02, 0.1), gain=(-0.3, 0.4), slow=(-0.15, 0.15),
        delay=(2, 14), near=(0.3, 3), gap=(0.4, 1.0), restitution=(0.4, 0.9),
    )  # fmt: skip
    return {name: rng.uniform(*ends, number) for name, ends in ranges.items()}


def test_linear_equation_is_exact():
    run = vi.simulate(Linear(), cycles=4, method="reference")
    exact = [1.0, 0.1583333333333333, 0.02024112654320987]
    np.testing.assert_allclose(run.sections.x[:3], exact, rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.sections.x[4], -4.606955991e-4, rtol=0, atol=1e-12)


def test_derivative_with_respect_to_a_delay():
    class Lagged(Linear):
        lag: float = 1.0
        delays = property(lambda self: dict(lag=self.lag))

    @jax.jit
    def slope(lag):
        end = lambda lag: vi.simulate(Lagged(lag=lag), method="reference").last.x
        return jax.jvp(end, (lag,), (1.0,))[1]

    # x(5) = Σ (-1)^k (5 - (k - 1) T)^k / k!, of which T is the delay.
    terms = [(-1) ** k * (1 - k) * (6 - k) ** (k - 1) / math.factorial(k - 1) for k in range(1, 6)]
    np.testing.assert_allclose(slope(1.0), sum(terms), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_derivatives_pass_through_history_and_images():
    names = ("gain", "delay", "restitution", "damping", "gap", "first")
    values = jnp.array([0.3, 4.0, 0.7, 0.05, 0.6, 0.0])

    def end(values):
        machine = Struck(**dict(zip(names, values, strict=True)))
        last = vi.simulate(machine, cycles=5, method="reference").last
        return jnp.array([last.x, last.u])

    backward = jax.jit(jax.jacrev(end))(values)
    wanted = [
        [-0.430489847, 2.116946376], [-0.070574524, 0.502590888], [-2.128487819, -2.569314730],
        [7.660579518, 5.831451311], [2.886460679, -2.012359144], [-0.000886436, 0.011725705],
    ]  # fmt: skip
    np.testing.assert_allclose(backward.T, wanted, rtol=0, atol=1e-8)


def test_turning_tool_leaves_the_cut():
    run = vi.simulate(Turning(), cycles=25, event_log=4, method="reference")
    wanted = [0.5088833895, 0.9952359308, -0.3342284987]
    np.testing.assert_allclose(run.sections.x[jnp.array([10, 15, 25])], wanted, atol=1e-9)
    np.testing.assert_allclose(run.sections.u[25], 0.3354090455, atol=1e-9)
    instants = run.event_log.phase[10, :2] + 80
    np.testing.assert_allclose(instants, [84.0632905055, 84.5797966961], atol=1e-9)


def test_random_machines_with_two_delays():
    number = 10
    p = random_machines(number, 1)
    p["delay"][0] = 2 * np.pi / p["omega"][0]  # images of impacts coincide with impacts

    def end(p):
        run = vi.simulate(Two(**p), cycles=CYCLES, method="reference")
        return jnp.array([run.last.x, run.last.u]), run.impacts.sum()

    ends, impacts = jax.jit(jax.vmap(end))({name: jnp.asarray(x) for name, x in p.items()})
    for i in range(number):
        state, events = two_by_steps({name: x[i] for name, x in p.items()})
        assert len(events) == int(impacts[i])
        np.testing.assert_allclose(ends[i], state, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_derivatives_with_delayed_velocity():
    names, values = ("gain", "slow", "delay", "near"), jnp.array([0.3, 0.1, 4.0, 1.0])

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def end_and_slope(values, direction):
        def end(values):
            machine = Two(**dict(zip(names, values, strict=True)))
            last = vi.simulate(machine, cycles=3, method="reference").last
            return jnp.array([last.x, last.u])

        return jax.jvp(end, (values,), (direction,))

    step = 1e-5
    for direction in jnp.eye(4):
        near = values + step * jnp.array([0, 1, -1])[:, None] * direction
        ends, slopes = end_and_slope(near, direction)
        np.testing.assert_allclose(slopes[0], (ends[1] - ends[2]) / (2 * step), atol=1e-7)


class Echo(vi.Mechanical):
    """A body hits a wall. An echo of its velocity pushes a block that friction holds, and lifts one
    that rests on the floor. Units: m, s, kg, N."""

    gap: float = 0.2
    delay: float = 0.3
    level: float = 5.0
    weight: float = 5.0
    q = ("striker", "block", "lifted")
    mass = (1.0, 2.0, 2.0)
    cycle = 1.0
    before = property(lambda self: self.start())
    delays = property(lambda self: dict(echo=self.delay))

    @property
    def contacts(self):
        floor = vi.RigidStop(0.0, 0.5, "left", on="lifted")
        friction = vi.DryFriction(self.level, on="block")
        return vi.RigidStop(self.gap, 0.5, on="striker"), floor, friction

    def start(self):
        return self.at(v=dict(striker=1.0))

    def force(self, t, q, v, past):
        push = 4.9 + 2.4 * (1.0 - past.echo.v.striker)
        return dict(striker=0.0, block=push, lifted=push - self.weight)


def test_an_image_releases_held_bodies():
    p = jnp.array([0.2, 0.3, 5.1, 5.3])

    def found(p):
        run = vi.simulate(Echo(*p), cycles=1)
        found = jnp.stack([run.last.block, run.last.lifted])
        return found, found

    def wanted(p):
        return (8.5 - p[2:]) / 4 * (1 - p[0] - p[1]) ** 2

    slopes, values = jax.jit(jax.jacfwd(found, has_aux=True))(p)
    np.testing.assert_allclose(values, wanted(p), atol=1e-12)
    np.testing.assert_allclose(slopes, jax.jacfwd(wanted)(p), atol=1e-10)


class Slide(vi.Mechanical):
    """A slide with friction, a stop and two delayed feedbacks. Units: m, s, kg, N."""

    near: float = 0.035
    far: float = 0.09
    level: float = 6.0
    gap: float = 0.004
    q, mass, cycle, history_size = "x", 12.0, 1 / 2.6, 501
    delays = property(lambda self: dict(near=self.near, far=self.far))

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, 0.6, on="x"), vi.DryFriction(self.level, on="x")

    def force(self, t, q, v, past):
        late = 900 * (q.x - past.near.x) - 15 * past.far.v.x
        return dict(x=60 * jnp.sin(5.2 * jnp.pi * t) - 4800 * q.x - 24 * v.x + late)


def test_derivatives_with_friction_and_two_delays():
    p = jnp.array([0.035, 0.09, 6.0, 0.004])

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def end_and_slope(p, direction):
        def end(p):
            machine = Slide(*p)
            last = vi.simulate(machine, machine.at(x=0.001), 1).last
            return jnp.stack([last.x, last.v.x])

        return jax.jvp(end, (p,), (direction,))

    for direction in jnp.diag(p):
        near = p + 1e-5 * jnp.array([0, 1, -1, 2, -2])[:, None] * direction
        ends, slopes = end_and_slope(near, direction)
        np.testing.assert_allclose(ends[0], [-0.0208936219760, 0.1626080594120], rtol=1e-10)
        wanted = (8 * (ends[1] - ends[2]) - (ends[3] - ends[4])) / 12e-5
        np.testing.assert_allclose(slopes[0], wanted, atol=1e-9, rtol=1e-6)


def test_run_continues_with_its_history():
    first = vi.simulate(Struck(), cycles=1, settle=2)
    second = vi.simulate(Struck(), first.last, cycles=1, settle=1)
    np.testing.assert_allclose(second.last.x, -0.3721662410390, rtol=0, atol=1e-9)
    again = vi.simulate(Struck(), first.last.state, cycles=1, settle=1)  # without its history
    assert abs(float(again.last.x - second.last.x)) > 1e-3


def test_machine_of_masses():
    run = vi.simulate(Masses(), cycles=5)
    np.testing.assert_allclose(run.last.x, -0.3721662410390, rtol=0, atol=1e-9)


class Rubbing(Struck):
    """`Struck` with dry friction."""

    level: float = 0.3
    history_size = 301

    @property
    def contacts(self):
        return super().contacts, vi.DryFriction(self.level, on="u", mass=1.0)


def compare_with_steps(machine, cycles, kinds, modes):
    """Compare the last state, and the instants of some kinds of events, which end these modes."""
    names = ("omega", "gain", "delay", "gap", "restitution")
    m = {name: getattr(machine, name) for name in names} | {"level": getattr(machine, "level", 0)}
    run = vi.simulate(machine, cycles=cycles, event_log=40, method="reference")
    end, events = struck_by_steps(m, cycles)
    np.testing.assert_allclose([run.last.x, run.last.u], end, rtol=0, atol=1e-11)
    log, length = run.event_log, 2 * np.pi / m["omega"]
    instants = np.asarray(log.phase) + length * np.arange(cycles)[:, None]
    found = instants[np.isin(np.asarray(log.kind), [vi.EVENTS.index(x) for x in kinds])]
    wanted = [t for t, mode in events if mode in modes]
    assert len(found) == len(wanted) > cycles - 2
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-11)


def test_impacts_and_friction():
    machine = Rubbing(omega=0.5, delay=5.0, gap=0.4, restitution=0.6)
    compare_with_steps(machine, 2, ("impact", "mode"), (-1, 0, 1))


class Resting(Struck):
    history_size = 501


@pytest.mark.slow
@pytest.mark.parametrize(
    "machine",
    [
        Resting(omega=0.5, gap=0.2, restitution=0.0, delay=17.0),
        Resting(omega=0.45, gain=0.2, gap=0.25, restitution=0.4, delay=7.0),
        Resting(omega=0.4, gap=0.3, restitution=0.5),
    ],
)
def test_rests(machine):
    compare_with_steps(machine, 4, ("release",), (2,))


class Kicked(Linear):
    """A reset whose guard and jump read the past."""

    events = vi.Reset(
        lambda m, t, z, past: past.lag.x - z.x - 0.5, lambda m, t, z, past: dict(y=z.y + past.lag.x)
    )

    def field(self, t, z, past):
        return dict(x=-past.lag.x, y=-z.y)

    def start(self):
        return vi.State(x=1.0, y=0.0)


def test_reset_reads_the_past():
    run = vi.simulate(Kicked(), cycles=1, event_log=6, method="reference")
    y, events = by_steps(
        lambda t, y, past: [-past[0][0], -y[1]], [1.0, 0.0], lambda t: [1.0, 0.0], [1.0], 5.0,
        guard=lambda t, y, past: past[0][0] - y[0] - 0.5,
        jump=lambda y, past: [y[0], y[1] + past[0][0]],
    )  # fmt: skip
    found = run.event_log.phase[0]
    assert len(events) > 0
    np.testing.assert_allclose(found[~jnp.isnan(found)], events, rtol=0, atol=1e-9)
    np.testing.assert_allclose([run.last.x, run.last.y], y, rtol=0, atol=1e-9)


def test_full_history_ends_a_lane_with_its_reason():
    class Short(Struck):
        history_size = 9

    run = vi.simulate(Short(), cycles=5)
    assert run.result == vi.RESULTS.full_history
    assert "history_size" in vi.RESULTS[run.result]


def test_traced_delays_out_of_range_end_their_lanes():
    lane = lambda delay: vi.simulate(Struck(delay=delay), cycles=2).result.number
    found = jax.jit(jax.vmap(lane))(jnp.array([4.0, -1.0, 1e-3]))
    assert found.tolist() == [0, 1, 1]


class Plain(vi.AbstractMachine):
    cycle = 2 * np.pi / 0.8
    contacts = vi.RigidStop(0.6, 0.7, on=("x", "u"))

    def field(self, t, z):
        return dict(x=z.u, u=jnp.cos(0.8 * t) - z.x - 0.1 * z.u)

    def start(self):
        return vi.State(x=0.0, u=0.0)


class Empty(Plain):
    delays = property(lambda self: {})


def program(machine):
    """Return the equations of a simulation and its derivatives, those of all loops included."""
    end = lambda x: vi.simulate(machine, vi.State(x=x, u=0.0), cycles=3).last.x
    with lanes.backend("xla"):
        return str(jax.make_jaxpr(lambda x: jax.jvp(end, (x,), (1.0,)))(0.1))


def test_machines_without_delays_have_no_more_operations(monkeypatch):
    def fails(*args, **kwargs):
        raise AssertionError("only for machines with delays")

    # Without the functions of histories: every name that a step, a loop or a plan imports.
    for name in ("arguments", "loop", "_step.hybrid", "_step.trial", "_step.arrive"):
        module = importlib.import_module(f"vi_jax.flow.{name}")
        for key, value in list(vars(module).items()):
            if getattr(value, "__module__", None) == "vi_jax.flow.history":
                monkeypatch.setattr(module, key, fails)
    jax.clear_caches()
    plain, empty = (program(machine).count(" = ") for machine in (Plain(), Empty()))
    assert plain == empty > 1000
    with pytest.raises(AssertionError, match="only for machines with delays"):
        program(Struck())


class Renewed(Struck):
    def renewed(self, state):
        return state.replace(x=0.0)


class Blind(Linear):
    def field(self, t, z, past):
        return dict(x=-z.x)


class WithoutPast(Turning):
    events = vi.Switch(lambda m, t, z: -z.x)


class NoBefore(Turning):
    before = None


def test_refusals_name_what_is_wrong():
    noise = dict(noise=vi.WhiteNoise(dict(u=0.1)), key=jax.random.key(0))
    for machine, options, words in (
        (Struck(delay=1e-3), {}, "a thousandth of a cycle"),
        (Struck(delay=-1.0), {}, "sensor is -1"),
        (Struck(), noise, "must be left out for a Struck"),
        (Struck(), dict(method=vi.Taylor()), "must be `Adaptive` or `FixedStep`"),
        (Struck(), dict(method=vi.ExactFlight()), "must be `Adaptive` or `FixedStep`"),
        (Renewed(), {}, "must not have both `delays` and `renewed`"),
        (Blind(), {}, "nothing reads its past"),
        (NoBefore(), {}, "`before` of a NoBefore must be given"),
    ):
        with pytest.raises(ValueError, match=words):
            vi.simulate(machine, **options)
    with pytest.raises(TypeError, match="must take the machine, `t`, the state, the past"):
        vi.simulate(WithoutPast())
    with pytest.raises(TypeError, match=r"needs the chain as its machine, .* `orbit.machine`"):
        vi.simulate(Struck(), vi.delay_chain(Struck()).start())
    with pytest.raises(TypeError, match="`field` of a Struck must be computable, but: The state"):
        vi.simulate(Struck(), vi.State(x=0.0))


def test_a_state_of_a_chain_has_its_history():
    chain, other = (vi.delay_chain(Struck(), nodes) for nodes in (4, 8))
    for call in (
        lambda: vi.simulate(chain, vi.State(x=0.0, u=0.0)),
        lambda: vi.simulate(chain, other.start()),
        lambda: vi.find_orbit(chain, vi.State(x=0.0, u=0.0)),
        lambda: vi.find_orbit(chain, vi.HybridState(vi.State(x=0.0, u=0.0), (), None)),
    ):
        with pytest.raises(TypeError, match=r"of shape \(4, 1\), but has .* Pass `machine.chained"):
            call()
    run = vi.simulate(chain)
    assert re.search(r"last section: x = \S+, u = \S+, history = \S+ … \S+ \(4 × 1\)\n", str(run))
