"""Machines whose state jumps by rules of their own, each with numbers known otherwise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


class Legs(eqx.Module):
    """Angles of the leg that stands and between both, with their rates."""

    stance: jax.Array
    turning: jax.Array
    between: jax.Array
    swinging: jax.Array


def legs(stance, turning):
    """Just after a heel strike."""
    swinging = turning * (1 - jnp.cos(2 * stance))
    return Legs(*map(jnp.asarray, (stance, turning, 2 * stance, swinging)))


class Walker(vi.AbstractMachine):
    """The simplest walker (Garcia, Chatterjee, Ruina and Coleman, J. Biomech. Eng. 120, 1998): with
    a heel strike, which ends a cycle, the legs change their parts. The foot that swings scuffs the
    ground as it passes the other."""

    slope: jax.Array = eqx.field(converter=jnp.asarray)
    cycle = 4.0

    @property
    def events(self):
        return (
            vi.Reset(
                lambda machine, s, x: x.between - 2 * x.stance,
                lambda machine, s, x: legs(-x.stance, x.turning * jnp.cos(2 * x.stance)),
                when=lambda machine, s, x: x.between < -0.05,
                ends_cycle=True,
                name="heel strike",
            ),
        )

    def field(self, s, x):
        falls = jnp.sin(x.stance - self.slope)
        pull = (x.turning**2 - jnp.cos(x.stance - self.slope)) * jnp.sin(x.between)
        return Legs(x.turning, falls, x.swinging, falls + pull)

    def position(self, x):
        return x.stance

    def velocity(self, x):
        return x.turning

    def step_limit(self, s, x):
        return 0.8


class Sliding(eqx.Module):
    """Place and speed of an impactor, and how fast what it drives slides."""

    q: jax.Array
    v: jax.Array
    u: jax.Array


class StickSlip(vi.AbstractMachine):
    """An impactor drawn by a voltage (COCO's example of impacts with stick and slip, Dankowicz and
    Schilder, Recipes for Continuation, 2013): an impact makes the base slide until friction holds
    it. The mode is 1 while it slides."""

    voltage: jax.Array = eqx.field(converter=jnp.asarray)

    @property
    def cycle(self):
        return np.pi / 0.92

    @property
    def events(self):
        impact = vi.Reset(
            lambda machine, s, x, slides: x.q - 0.5,
            lambda machine, s, x, slides: Sliding(x.q, -0.8 * x.v, 0.3 * x.v),
            modes=lambda machine, s, x, slides: (1.0,),
            value=lambda machine, s, x, slides: x.v,
            name="impact",
        )
        sticks = vi.Reset(
            lambda machine, s, x, slides: jnp.where(slides > 0, -x.u, -1.0),
            lambda machine, s, x, slides: Sliding(x.q, x.v, jnp.zeros_like(x.u)),
            modes=lambda machine, s, x, slides: (0.0,),
        )
        return impact, sticks

    def modes(self, s, x):
        return (jnp.where(x.u > 0, 1.0, 0.0),)

    def force(self, s, x):
        drawn = (self.voltage * jnp.sin(0.92 * s) / (1 - x.q)) ** 2
        return drawn - 0.04 * x.v - x.q

    def field(self, s, x, slides):
        force = self.force(s, x)
        # While it sticks u is zero: what fades there leaves no neutral component.
        pulled = jnp.where(slides > 0, 3.17 + 1.2 * force, force)
        braked = jnp.where(slides > 0, -3.17 - 0.2 * force, -x.u)
        return Sliding(x.v, pulled, braked)

    def position(self, x):
        return x.q

    def velocity(self, x):
        return x.v


ROOTS = (-0.1 + 0.2j, -0.1 - 0.2j, -0.5)
A = np.column_stack([-np.poly(ROOTS).real[1:], [1, 0, 0], [0, 1, 0]])


class ThreeStates(vi.AbstractMachine):
    """x' = A x, and where x1 falls through 1 at the speed v: x2 -= b v, x3 -= 1.6 v."""

    b: jax.Array = eqx.field(converter=jnp.asarray)

    @property
    def cycle(self):
        return 5.0

    @property
    def events(self):
        def reset(machine, s, x):
            v = machine.velocity(x)
            return x[0], x[1] - machine.b * v, x[2] - 1.6 * v

        return (vi.Reset(lambda machine, s, x: 1 - x[0], reset, ends_cycle=True),)

    def field(self, s, x):
        return tuple(sum(a * y for a, y in zip(row, x, strict=True)) for row in A.tolist())

    def velocity(self, x):
        return A[0, 0] * x[0] + x[1]


class Excited(vi.AbstractMachine):
    """x'' = 0.2 x' - x against a stop; a cycle ends with an impact."""

    restitution: jax.Array = eqx.field(default=0.6, converter=jnp.asarray)

    @property
    def contacts(self):
        return (vi.RigidStop(1.0, self.restitution, ends_cycle=True),)

    @property
    def cycle(self):
        return 6.0

    def field(self, s, x):
        return vi.OscillatorState(x.V, 0.2 * x.V - x.Y)


class Toggled(vi.AbstractMachine):
    """A body between two walls, drawn to the one that it did not hit last; by time."""

    restitution: jax.Array = eqx.field(default=0.8, converter=jnp.asarray)

    @property
    def contacts(self):
        def drawn_away(side):
            return lambda machine, s, x, pull: (side,)

        return (
            vi.RigidStop(1.0, self.restitution, modes=drawn_away(-1.0)),
            vi.RigidStop(1.0, self.restitution, "left", modes=drawn_away(1.0)),
        )

    @property
    def cycle(self):
        return 10.0

    def modes(self, s, x):
        return (1.0,)

    def field(self, s, x, pull):
        return vi.OscillatorState(x.V, pull)

    def step_limit(self, s, x):
        return 0.5
