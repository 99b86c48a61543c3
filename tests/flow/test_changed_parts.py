"""Subclasses of ready machines and parts: a change is used, or an error names it."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


class Weighted(vi.IdealDrive):
    """Drive of a body with a weight."""

    def field(self, scene, s, state, pushes):
        rate = super().field(scene, s, state, pushes)
        return vi.OscillatorState(rate.Y, rate.V + 0.5 / self.frequency_ratio)


class Faster(vi.IdealDrive):
    @property
    def fixed_speed(self):
        return 2 * self.frequency_ratio


class Pulled(vi.Scene):
    def pull(self, stretch, speed, pushes):
        return super().pull(stretch, speed, pushes) + 0.5


class Named(vi.Scene):
    """A scene with other labels and an average, but the same equations."""

    labels = "x", "v"

    def averages(self, s, state):
        return {"speed": state.V}


class Wide(vi.CosineCrank):
    def slide(self, phase):
        return super().slide(phase)._replace(U=1.5 * jnp.cos(phase))


def scene(kind=vi.Scene, drive=vi.IdealDrive, crank=vi.CosineCrank, gap=1.2, soft=()):
    stop = vi.RigidStop(gap, 0.5)
    return kind(0.1, drive(0.9), (stop,), crank(), soft_stops=soft)


@pytest.mark.parametrize(
    "machine, what",
    [
        (scene(drive=Weighted), "`Weighted` has another `field`"),
        (scene(drive=Faster), "`Faster` has another `fixed_speed`"),
        (scene(Pulled), "`Pulled` has another `pull`"),
        (scene(crank=Wide), "`Wide`"),
    ],
)
def test_changed_equations_have_no_closed_form(machine, what):
    with pytest.raises(ValueError, match=what):
        vi.ExactFlight().check(machine)
    assert isinstance(vi.preset(machine), vi.FixedStep)
    assert isinstance(vi.preset(scene(Named)), vi.ExactFlight)


@pytest.mark.parametrize(
    "machine, may",
    [
        (scene(), False), (scene(gap=0.9), True), (scene(crank=Wide), True),
        (scene(drive=Weighted), True), (scene(Pulled), True),
        (scene(soft=(vi.SoftStop(0.8, 10.0, side="left"),)), True),
    ],
)  # fmt: skip
def test_may_rest_if_a_force_can_press_the_body_on_a_stop(machine, may):
    assert machine.may_rest() is may


class Slanted(vi.machines.Structure):
    """Doubles the position, so that `at` alone no longer defines the coordinate."""

    @property
    def coordinates(self):
        own = super().coordinates[0]
        return (own._replace(position=lambda x: 2 * own.position(x)),)


def test_structure_uses_its_stops_and_the_coordinates_of_its_subclass():
    """In x'' + x = 0, each impact at 0.5 = sin(π/6) moves the phase from π/6 to 5π/6."""
    matrices = {"mass": jnp.ones(1), "stiffness": jnp.ones(1)}
    stop = vi.RigidStop(0.5, 1.0, at=[1.0])
    machine = vi.machines.Structure(**matrices, frequency=1.0, contacts=(stop,))
    run = vi.simulate(machine, machine.start(velocity=1.0), 3)
    times = np.pi / 6 + 4 * np.pi / 3 * np.arange(6)
    times = times[times < 6 * np.pi]
    assert int(run.impacts.sum()) == len(times)
    place = np.sin(6 * np.pi - times[-1] + 5 * np.pi / 6)
    np.testing.assert_allclose(run.last.displacement, [place], atol=1e-9)
    table = run.to_xarray(along="section").to_dataframe()  # a column for each number of an array
    assert len(table) == 4
    assert set(table) == {"section_displacement[0]", "section_velocity[0]"}
    slanted = Slanted(**matrices, contacts=(vi.RigidStop(0.5, 1.0, at=[1.0]),))
    assert isinstance(slanted.prepared().machine, Slanted)
    assert not isinstance(vi.preset(slanted), vi.ExactFlight)
