"""Machines with resets, for which the tests have independent results."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


def legs(stance, turning):
    """Return the state after a heel strike: stance angle, inter-leg angle, and rates."""
    swinging = turning * (1 - jnp.cos(2 * stance))
    return vi.State(stance=stance, turning=turning, between=2 * stance, swinging=swinging)


class Walker(vi.AbstractMachine):
    """The simplest walker (Garcia, Chatterjee, Ruina and Coleman, J. Biomech. Eng. 120, 1998). At a
    heel strike, which ends a cycle, the legs exchange roles. Foot scuffing is ignored."""

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
        return dict(
            stance=x.turning, turning=falls, between=x.swinging, swinging=falls + pull
        )  # fmt: skip

    def step_limit(self, s, x):
        return 0.8


class StickSlip(vi.AbstractMachine):
    """An electrostatic impactor (COCO's example with stick and slip, Dankowicz and Schilder,
    Recipes for Continuation, 2013). After an impact the base slides until friction stops it. The
    mode is 1 while it slides."""

    voltage: jax.Array = eqx.field(converter=jnp.asarray)

    cycle = np.pi / 0.92
    events = (
        vi.Reset(
            lambda machine, s, x, slides: x.q - 0.5,
            lambda machine, s, x, slides: dict(v=-0.8 * x.v, u=0.3 * x.v),
            modes=lambda machine, s, x, slides: 1.0,
            value=lambda machine, s, x, slides: x.v,
            name="impact",
        ),
        vi.Reset(
            lambda machine, s, x, slides: jnp.where(slides > 0, -x.u, -1.0),
            lambda machine, s, x, slides: dict(u=0.0),
            modes=lambda machine, s, x, slides: 0.0,
        ),
    )

    def modes(self, s, x):
        return (jnp.where(x.u > 0, 1.0, 0.0),)

    def field(self, s, x, slides):
        force = (self.voltage * jnp.sin(0.92 * s) / (1 - x.q)) ** 2 - 0.04 * x.v - x.q
        # u is zero while the base sticks; u' = -u there avoids a Floquet multiplier of 1.
        braked = jnp.where(slides > 0, -3.17 - 0.2 * force, -x.u)
        return dict(q=x.v, v=force + slides * (3.17 + 0.2 * force), u=braked)


class Excited(vi.AbstractMachine):
    """x'' = 0.2 x' - x with a stop; a cycle ends at an impact."""

    restitution: jax.Array = eqx.field(default=0.6, converter=jnp.asarray)

    @property
    def contacts(self):
        return (vi.RigidStop(1.0, self.restitution, ends_cycle=True),)

    cycle = 6.0

    def field(self, s, x):
        return vi.OscillatorState(x.V, 0.2 * x.V - x.Y)
