"""Compiled programs contain only what a scene needs, and no values of parameters."""

from collections import Counter

import jax
import vi_jax as vi
from vi_jax.lanes._program import LaneProgram


def equations(jaxpr):
    """Yield the equations of a jaxpr and of all jaxprs that it calls."""
    for equation in jaxpr.eqns:
        yield equation
        for parameter in equation.params.values():
            parameter = getattr(parameter, "jaxprs", parameter)  # of a loop over lanes
            for inner in parameter if isinstance(parameter, tuple | list) else (parameter,):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


def primitives(jaxpr) -> Counter:
    return Counter(equation.primitive.name for equation in equations(jaxpr))


def carried(jaxpr) -> int:
    """Return the number of arrays that the lane's loop carries."""
    parameters = [x for equation in equations(jaxpr) for x in equation.params.values()]
    return max(len(x.carry_avals) for x in parameters if isinstance(x, LaneProgram))


def program(scene, start, **options):
    options = {"method": vi.FixedStep(), "record": "sections", **options}
    return jax.make_jaxpr(lambda s: vi.simulate(scene, s, 3, **options).sections)(start).jaxpr


IDEAL = vi.Scene.ideal(frequency_ratio=0.9)
FREE = vi.Scene.ideal(frequency_ratio=0.9, gap=None)
MOTOR = vi.Parameters().scene()


def test_no_search_without_stops():
    with_stop, without = (primitives(program(s, s.start())) for s in (IDEAL, FREE))
    assert with_stop["sqrt"] > 0  # landing on an impact
    assert without["sqrt"] == 0
    assert without.total() < with_stop.total()
    two = vi.Scene(
        oscillator=IDEAL.oscillator, drive=IDEAL.drive,
        stops=(*IDEAL.stops, vi.RigidStop(2.0, 0.5, "left")),
    )  # fmt: skip
    assert primitives(program(two, two.start())).total() > with_stop.total()


def test_loop_carries_only_the_needed_state():
    ideal, motor = program(IDEAL, IDEAL.start()), program(MOTOR, MOTOR.start())
    timed = program(MOTOR, MOTOR.start(), clock="time")
    assert carried(motor) == carried(ideal) + 1  # W
    assert carried(timed) == carried(motor) + 1  # φ
    assert primitives(ideal).total() < primitives(motor).total()
    # Elapsed time, extremes, speeds and energies are carried only if they are recorded.
    assert carried(program(MOTOR, MOTOR.start(), record="motion")) == carried(motor) + 5
    assert carried(program(IDEAL, IDEAL.start(), record="motion")) == carried(ideal) + 4


def test_tolerance_is_a_dynamic_leaf():
    first, second = (jax.tree.structure(vi.Adaptive(rtol=r)) for r in (1e-6, 1e-9))
    assert first == second
    assert len(jax.tree.leaves(vi.Adaptive(rtol=1e-6))) == 1
