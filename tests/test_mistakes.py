"""Error messages of ten common mistakes, in the order of the page `docs/faq.md`, and others."""

import dataclasses
import math
import warnings
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax._checks import instance_of
from vi_jax.machine import check_leaf

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.05)


class Machine(vi.AbstractMachine):
    """A driven oscillator with a stop; subclasses make a mistake in its field."""

    omega: jax.Array | float = 0.9
    contacts: tuple = (vi.RigidStop(2.0, 0.5),)

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    def start(self):
        return vi.OscillatorState(jnp.array(0.0), jnp.array(0.0))

    def force(self, s, x):
        return jnp.cos(self.omega * s)

    def field(self, s, x):
        return vi.OscillatorState(x.V, self.force(s, x) - x.Y)


class OtherPeriod(Machine):
    def force(self, s, x):
        return jnp.cos(s)


class ByNumpy(Machine):
    def force(self, s, x):
        return np.cos(self.omega * s)


class ByMath(Machine):
    def force(self, s, x):
        return math.cos(self.omega * s)


class WithIf(Machine):
    def force(self, s, x):
        return 1.0 if x.Y > 0 else 0.0


class Free(vi.AbstractMachine):
    """An oscillator without contacts; subclasses make a mistake in its force."""

    cycle = 2 * np.pi

    def field(self, t, z):
        return dict(x=z.u, u=self.force(t, z) - z.x)


class FreeByNumpy(Free):
    def force(self, t, z):
        return np.cos(z.x)


class RubbedByNumpy(FreeByNumpy):
    contacts = vi.DryFriction(0.1, on="u")


class Harmonic(Free):
    def force(self, t, z):
        return 0.0


class PushedPosition(Harmonic):
    contacts = (vi.RigidStop(1.0, 0.5, on=("x", "u")), vi.DryFriction(0.1, on="x"))


class CycleByNumpy(Harmonic):
    length: float = 6.0

    @property
    def cycle(self):
        return np.sqrt(self.length)


class CycleByZero(Harmonic):
    frequency: float = 0.0

    @property
    def cycle(self):
        return 1 / self.frequency


class WithUnits(Harmonic):
    units: ClassVar = {"x": "mm", "spede": "mm/s"}

    def quantities(self, t, z):
        return {"speed": jnp.abs(z.u)}


class StopByNumpy(Harmonic):
    gap: float = 2.0

    @property
    def contacts(self):
        return vi.RigidStop(np.sqrt(self.gap), 0.5, on=("x", "u"))


class FreeWithIf(Free):
    def force(self, t, z):
        return 1.0 if z.x > 0 else 0.0


class HalfPeriod(Free):
    """The force is zero at both ends of the cycle."""

    cycle = np.pi

    def force(self, t, z):
        return jnp.sin(t)


class DrivenSection(HalfPeriod):
    cycle = vi.rising("u", usual=6.3)


class Clocked(HalfPeriod):
    gain: float = 0.3
    cycle = 2 * np.pi
    events = vi.Reset(lambda m, t, z: t - m.cycle, ends_cycle=True)

    def force(self, t, z):
        return jnp.sin(t) - self.gain * z.u


class Method(Free):
    velocity: Any


def number_as_method():
    class Decay(Free):
        relaxation = 1.0


def number_as_units():
    class Dimensionless(Free):
        units: float = 1.0


def own_private_method():
    class Sorted(Free):
        def _stops(self):
            return ()


class Tuple(Machine):
    def field(self, s, x):
        return x.V, -x.Y


def simulate(machine):
    free = isinstance(machine, Free)
    return vi.simulate(machine, vi.State(x=0.1, u=0.2) if free else machine.start(), 2)


def refused(call):
    """Return the error message of a call."""
    with pytest.raises((TypeError, ValueError)) as caught:
        call()
    return str(caught.value)


def warned(call):
    """Return the warnings of a call."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        call()
    return " ".join(str(x.message) for x in caught)


def test_1_an_unknown_name():
    wrong = lambda: vi.scan(SCENE, {"frequency_ratio": [0.9]})
    assert "near names: drive.frequency_ratio" in refused(wrong)
    assert "it is called `Y`" in refused(lambda: SCENE.start(y=0.5))


def test_2_other_units():
    assert "lengths are in metres" in warned(lambda: vi.Parameters(gap=80.0))
    assert "in [0, 1], but got 50" in refused(lambda: vi.RigidStop(1.0, 50.0))


def test_3_single_precision():
    with jax.enable_x64(False):
        scene = vi.Scene.ideal(frequency_ratio=0.9)
        said = warned(lambda: vi.simulate(scene, scene.start(), 1))
    assert 'call `jax.config.update("jax_enable_x64", True)` first' in said


def test_4_arguments_in_another_order():
    """`refused_calls.py` has a call with machine and start swapped."""
    said = refused(lambda: vi.RigidStop(0.5, 2.0))
    assert "`restitution` must be finite and in [0, 1]" in said


def test_5_a_field_with_another_period():
    said = warned(lambda: simulate(OtherPeriod()))
    assert "`cycle` must be a period of the field" in said
    assert "the value of its w differs" in warned(lambda: simulate(Masses()))
    assert "is not the same a `cycle` = 3.14159 later" in warned(lambda: simulate(HalfPeriod()))
    assert "but an event ends its cycles" in warned(lambda: simulate(DrivenSection()))
    assert not warned(lambda: simulate(Machine()))


def test_6_a_start_beyond_the_stop():
    said = refused(lambda: vi.simulate(SCENE, SCENE.start(Y=3.0), 2))
    assert "must not lie beyond a stop, but lies 1 beyond stop 0 (right, gap 2.0)" in said
    orbit = vi.find_orbit(SCENE, SCENE.start(Y=3.0))
    assert "beyond a stop, say, or a number of the machine is not finite" in str(orbit)


def test_a_guess_that_is_nan():
    guess = vi.State(x=math.nan, u=1.0)
    with warnings.catch_warnings(action="error"):
        said = refused(lambda: vi.find_orbit(DrivenSection(), guess))
    assert "`guess` must be finite, but its x is nan" in said


def test_an_unknown_attribute_of_a_result():
    run = vi.simulate(SCENE, SCENE.start(), 1)
    with pytest.raises(AttributeError, match="`Run` has no attribute `impact`; near names: impact"):
        run.impact  # noqa: B018  # pyright: ignore
    assert vi.RESULTS[1] == vi.RESULTS[vi.RESULTS.bad_start]  # pyright: ignore


def test_7_numpy_in_a_field():
    for kind in (ByNumpy, ByMath, FreeByNumpy, RubbedByNumpy, CycleByNumpy, StopByNumpy):
        said = refused(lambda kind=kind: simulate(kind()))
        assert "with the functions of `jax.numpy`" in said


def test_8_an_if_on_a_traced_number():
    for kind in (WithIf, FreeWithIf):
        assert "`jnp.where`, not `if`" in refused(lambda kind=kind: simulate(kind()))


def test_9_a_field_that_returns_no_state():
    said = refused(lambda: simulate(Tuple()))
    assert "must return the components of its state" in said
    assert "but returned (f64[], f64[])" in said


def test_10_a_guess_far_from_stable_motion():
    orbit = vi.find_orbit(
        SCENE, SCENE.start(Y=1.0, V=50.0), cycles=1, root_finder=vi.Newton(max_steps=2)
    )
    assert "begin nearer to one" in str(orbit)
    undamped = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0)
    orbit = vi.find_orbit(undamped, undamped.start(Y=1.92303, V=-0.876442))
    assert "unstable" in str(orbit)
    assert "`orbit` must be a stable orbit" in refused(lambda: vi.minimal_kick(undamped, orbit))


class NoCycle(vi.AbstractMachine):
    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y)


class Unlisted(NoCycle):
    cycle = 1.0
    stops = (vi.RigidStop(2.0, 0.5),)


def continue_clocked():
    orbit = vi.find_orbit(Clocked(), vi.State(x=0.1, u=0.2))
    return vi.continue_orbit(orbit, parameter="gain", bounds=(0.2, 0.4), progress=False)


def kick_another():
    other = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.1, damping_ratio=0.05)
    settled = vi.simulate(SCENE, SCENE.start(), 1, settle=300).last
    return vi.minimal_kick(other, vi.find_orbit(SCENE, settled), progress=False)


def basins_of(**options):
    return vi.basins(Machine(), {"start.Y": (0.0, 1.0)}, **options)


class NoType(Machine):
    stiffness = 2.0


class Assigns(Machine):
    def field(self, s, x):
        x.V = -x.Y
        return x


class Blind(Machine):
    events = (vi.Reset(lambda m, s, x: x.Y), vi.Switch(lambda m, s, x: x.V))

    def field(self, s, x, side):
        return super().field(s, x)


class Masses(vi.Mechanical):
    q = ("x", "w")
    mass = (1.0,)
    cycle = 2.0

    def prescribed(self, t):
        return {"w": 0.3 * t}

    def force(self, t, q, v):
        return {"x": -q.x}


class ByNumber(Masses):
    def prescribed(self, t):
        return 0.3 * t


class OtherGap(Masses):
    contacts = vi.RigidStop(1.0, 0.5, on=lambda q: q.y - q.x)


class WithoutMode(Masses):
    contacts, events = vi.DryFriction(0.1, on="x"), vi.Switch(lambda m, t, z: z.x)


class RubsPosition(vi.AbstractMachine):
    cycle, contacts = 1.0, vi.DryFriction(0.1, on="x")

    def field(self, t, z):
        return dict(x=z.u, u=-z.x)

    def start(self):
        return vi.State(x=0.0, u=0.0)


class RubbedByIf(RubsPosition):
    contacts = vi.DryFriction(lambda u: 0.2 if u < 0.1 else 0.1, on="u")


class RubbedByNobody(RubsPosition):
    contacts = vi.DryFriction(0.1, on="u", slip=lambda z: z.w - 0.2)


class FixedStop(Machine):
    wall: float = 0.5
    cycle = 2 * jnp.pi / 0.9
    contacts = vi.RigidStop(wall, 0.5)


@pytest.mark.parametrize(
    "verb",
    [
        lambda scene: vi.scan(scene, {"stops.0.gap": np.linspace(1, 2, 3)}),
        lambda scene: vi.basins(scene, {"start.Y": (-1, 1), "start.V": (-1, 1)}),
        lambda scene: vi.all_orbits(scene, 1, region={"start.Y": (-1, 1), "start.V": (-1, 1)}),
        lambda scene: vi.find_torus(scene, settle=10),
        lambda scene: vi.minimal_kick(scene),
    ],
)
def test_a_verb_of_the_host_that_is_traced(verb):
    def of_ratio(ratio):
        return verb(vi.Scene.ideal(frequency_ratio=ratio))

    for transform in (jax.grad, jax.jit):
        with pytest.raises(TypeError, match="the `Scene` is being traced"):
            transform(of_ratio)(0.9)


def test_a_parameter_that_the_class_body_has_used():
    with pytest.warns(UserWarning, match="reads its parameter 'wall', which may have no effect"):
        vi.sweep(FixedStop(), "wall", [0.5, 0.6], start=FixedStop().start(), cycles=2, settle=1)


class Unlimited(vi.machines.Duffing):
    contacts = ()


def test_a_parameter_of_a_ready_machine_is_read_there():
    assert not warned(lambda: check_leaf(Unlimited(), "damping"))


class Turning(Machine):
    cycle = vi.turn_of("psi")


class TurningInSeconds(Masses):
    cycle = vi.turn_of("psi", usual=6.0)


class Rising(Machine):
    cycle = vi.rising(lambda m, z: z.psi, usual=6.0)


class Renews(Harmonic):
    def renewed(self, z):
        z.replace(x=0.0)


class SlipOfNothing(RubsPosition):
    contacts = vi.DryFriction(0.1, on="u", slip=lambda z: None)


class GapOfNothing(Masses):
    contacts = vi.RigidStop(1.0, 0.5, on=lambda q: None)


class OnNothing(Masses):
    contacts = vi.SoftStop(0.1, 9.0)


class VelocityInPlaces(Masses):
    def force(self, t, q, v):
        return dict(x=-q.v.x)


class AveragesOfForces(Masses):
    def averages(self, t, q, v):
        return dict(power=v.x**2)


class WithoutSpeed(Masses):
    def force(self, t, q):
        return dict(x=-q.x)


class CycleInWords(Harmonic):
    cycle = "1.0"  # pyright: ignore


class RowOfForces(Masses):
    def force(self, t, q, v):
        return dict(x=jnp.array([1.0]))


class Driving(Machine):
    contacts = (vi.DryFriction(0.1, on="V", load=lambda x: -9.81),)


class DrivingLater(Machine):
    contacts = (vi.DryFriction(0.1, on="V", load=lambda s, x: jnp.cos(s)),)


class Spare(Machine):
    events = vi.Switch(lambda m, s, x, side: x.V)


@pytest.mark.parametrize(
    ("base", "member"),
    [(Machine, x) for x in ("cycle", "contacts", "events", "modes", "units", "coordinates")]
    + [(Machine, x) for x in ("field", "start", "step_limit", "averages", "quantities")]
    + [(Masses, x) for x in ("force", "mass", "prescribed", "start")],
)
def test_a_method_without_its_return(base, member):
    method = lambda self, *args: None
    of_property = member in ("cycle", "contacts", "events", "units", "coordinates")
    kind = type("Forgetful", (base,), {member: property(method) if of_property else method})
    with warnings.catch_warnings(action="error"):
        said = refused(lambda: vi.simulate(kind(), cycles=1))
    assert said.startswith(f"`{member}` of a Forgetful must return ")
    assert said.endswith(", but its `return` is missing.")


def nothing(*args):
    return None


@pytest.mark.parametrize(
    ("member", "part", "whose"),
    [
        ("contacts", vi.DryFriction(nothing, on="V"), "`level` of a DryFriction"),
        ("contacts", vi.DryFriction(0.1, on="V", load=nothing), "`load` of a DryFriction"),
        ("contacts", vi.RigidStop(1.0, nothing), "The restitution law of stop 0"),
        ("cycle", vi.rising(nothing, usual=6.3), "The function in `cycle`"),
        ("cycle", vi.rising("V", usual=nothing), "`usual` in the `cycle`"),
        ("events", vi.Switch(nothing), "The function of a Switch"),
        ("events", vi.Reset(lambda m, s, x: x.Y, when=nothing), "`when` of a Reset"),
    ],
)
def test_a_part_without_its_return(member, part, whose):
    kind = type("Forgetful", (Machine,), {member: part})
    said = refused(lambda: vi.simulate(kind(), cycles=1))
    assert said.startswith(f"{whose} of a Forgetful must ")
    assert said.endswith(", but its `return` is missing.")


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: simulate(Blind()), "of a Blind must take the machine, `t`, the state and 1 mode"),
        (
            lambda: simulate(Spare()),
            "of a Switch of a Spare must take the machine, `t`, the state, but takes `m`, `s`, `x`",
        ),
        (lambda: NoType(stiffness=3.0), "in the class, `stiffness: float = 2.0`"),
        (lambda: Machine(omegga=1.0), "`Machine` has no argument `omegga`; near names: omega"),
        (lambda: Free(omega=1.0), "`Free` has no argument `omega`; it takes none"),
        (lambda: vi.Regime(longst=4), "`Regime` has no argument `longst`; near names: longest"),
        (lambda: vi.Reset(lambda m, t, z: z.x, modes=1.0), "`modes` of a Reset must be a function"),
        (lambda: vi.simulate(Harmonic(), {"x": 0.0, "u": 1.0}, 1), "Pass `vi.State(x=0.0, ...)`"),
        (lambda: Masses().at(vx=1.0), "the coordinates x. Give velocities by name in `v`: `at(x"),
        (lambda: Masses().at(w=1.0), "The motion of 'w' is prescribed by the machine"),
        (
            lambda: vi.simulate(Masses(), Masses().at(x=jnp.ones(2)), 1),
            "`start` must be one state (use `jax.vmap` for a batch), but its x has shape (2,)",
        ),
        (lambda: simulate(VelocityInPlaces()), "`q` has the positions and `v` the velocities"),
        (lambda: simulate(AveragesOfForces()), "must take `t`, the state, but takes `t`, `q`, `v`"),
        (lambda: simulate(WithoutSpeed()), "must take `t`, `q`, `v`, but takes `t`, `q`"),
        (lambda: simulate(Assigns()), "must return new numbers"),
        (lambda: simulate(Turning()), "`cycle` of a Turning must name one of the components Y, V"),
        (lambda: simulate(TurningInSeconds()), "x, w, v.x, v.w, but names 'psi'"),
        (lambda: simulate(Rising()), "`cycle` of a Rising must be computable, but: "),
        (lambda: simulate(Renews()), "`renewed` of a Renews must be like its state, State(x, u)"),
        (lambda: vi.simulate(SlipOfNothing(), cycles=1), "`slip` of a DryFriction of a SlipOf"),
        (lambda: simulate(GapOfNothing()), "must return a number, but its `return` is missing"),
        (lambda: simulate(CycleByZero()), "`cycle` of a CycleByZero must be finite, but divides"),
        (lambda: simulate(CycleInWords()), "must be a number, or a property that gives one, but"),
        (lambda: simulate(WithUnits()), "but has 'spede'; near names: speed"),
        (lambda: vi.sweep(SCENE, "start.Y", [1.0]), "its names: damping_ratio, drive.freq"),
        (
            lambda: vi.simulate(
                dataclasses.replace(SCENE, soft_stops=(vi.SoftStop(1.0, 9.0, mass=2.0),)), None, 1
            ),
            "Soft stop 0 of a Scene must have no `mass`",
        ),
        (lambda: vi.simulate(Masses(), vi.State(x=0.0, w=0.0), 1), "a state with x, w, v.x, v.w"),
        (lambda: simulate(ByNumber()), "must return positions by name, `dict(w=...)`"),
        (lambda: simulate(OtherGap()), "must be a function of the coordinates: The state has no"),
        (lambda: simulate(WithoutMode()), "must take `t`, `q`, `v` and 1 mode "),
        (lambda: vi.SoftStop(0.1, 9.0, restitution=0.5, dashpot=1.0), "`dashpot` must be left out"),
        (lambda: vi.simulate(RubsPosition(), cycles=1), "its rate is 'u'. Write `on='u'`"),
        (lambda: vi.simulate(RubbedByIf(), cycles=1), "`level` of a DryFriction of a"),
        (lambda: vi.simulate(RubbedByNobody(), cycles=1), "`slip` of a DryFriction of a Rubbed"),
        (lambda: simulate(OnNothing()), "OnNothing must be given: `on='x'`, or another of"),
        (lambda: simulate(RowOfForces()), "its rate of v.x has shape (1,), not ()"),
        (lambda: simulate(Driving()), "must not be negative, but is -0.981 at the start"),
        (lambda: simulate(DrivingLater()), "9 at t = 3.14296, in the state of the start"),
        (lambda: simulate(PushedPosition()), "must be the name of a velocity"),
        (lambda: Method(1.0), "'velocity' of a Method must have another name"),
        (number_as_method, "'relaxation' of a Decay must have another name, since it is a method"),
        (number_as_units, "'units' of a Dimensionless must have another name, since it is"),
        (own_private_method, "'_stops' of a Sorted must have another name"),
        (continue_clocked, "must not have cycles that end at a given time"),
        (kick_another, "an orbit of this machine, but its stops.0.gap is 2, not 2.1"),
        (lambda: NoCycle(), "must have `cycle`, but `NoCycle` has none: write `cycle: float"),
        (lambda: Unlisted(), "must list its contacts as `contacts`"),
        (lambda: simulate(Machine(omega=jnp.ones(3))), "with a row as omega, take `jax.vmap`"),
        (lambda: basins_of(resolutions=9), "`basins` has no argument `resolutions`; near names: r"),
        (lambda: basins_of(noise=9), "`noise` must not be given to `basins`"),
        (lambda: instance_of("machine", Machine, vi.AbstractMachine, "one"), "`Machine(…)`, for"),
        (
            lambda: vi.simulate(
                vi.machines.Structure(
                    mass=[1.0], stiffness=[1.0], force=[1.0],
                    contacts=(vi.RigidStop(1.0, 0.5, at=[1.0], friction=0.3, along="x"),),
                ),
                None,
                1,
            ),
            "Stop 0 of a Structure must have no `friction`",
        ),
        (lambda: vi.find_orbit(SCENE, vi.simulate(SCENE, SCENE.start(), 1)), "take its `last`"),
        (lambda: vi.simulate(SCENE, vi.find_orbit(SCENE, SCENE.start()), 1), "take its `state`"),
        (
            lambda: vi.scan(SCENE, {"drive.frequency_ratio": [0.9]}, measure="period"),
            "there are: extremes, regime",
        ),
    ],
)  # fmt: skip
def test_others(call, says):
    assert says in refused(call)
