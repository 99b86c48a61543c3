"""Machines that only move at one reset per cycle, so that their section map can be any map."""

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi


class Kicked(vi.AbstractMachine):
    """The section map is `kick`; between resets the state is constant."""

    a: jax.Array = eqx.field(converter=jnp.asarray)
    b: jax.Array = eqx.field(converter=jnp.asarray)
    contacts: tuple = eqx.field(default=(), kw_only=True)
    cycle = 1.0

    @property
    def events(self):
        half = 2 * jnp.pi * 0.5
        return (
            vi.Reset(
                lambda machine, s, x: jnp.sin(2 * jnp.pi * s - half),
                lambda machine, s, x: machine.kick(*x),
            ),
        )

    def kick(self, *x):
        """Return the state after a cycle."""
        raise NotImplementedError

    def field(self, s, x):
        return tuple(0 * y for y in x)


def at(*x):
    return tuple(jnp.asarray(y, float) for y in x)


# Exponents of x, y, a and b.
POWERS = (
    (0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (2, 0, 0, 0), (1, 1, 0, 0),
    (0, 2, 0, 0), (3, 0, 0, 0), (1, 0, 1, 0), (1, 0, 0, 1), (0, 1, 0, 1), (1, 0, 0, 2),
    (3, 0, 0, 1),
)  # fmt: skip


class Polynomial(Kicked):
    """A polynomial map of (x, y) with parameters a and b; between kicks x' = -decay x³.
    All such maps share one compiled program."""

    shares: jax.Array = eqx.field(kw_only=True)
    decay: jax.Array = eqx.field(kw_only=True, converter=jnp.asarray)

    def field(self, s, x):
        return -self.decay * x[0] ** 3, 0 * x[1]

    def kick(self, x, y):
        powers = [x**i * y**j * self.a**k * self.b**n for i, j, k, n in POWERS]
        return tuple(self.shares @ jnp.stack(powers))


def polynomial(a, b, *rows, decay=0.0):
    """Return a machine; each row maps exponents to the coefficient of their term."""
    shares = [[row.get(power, 0.0) for power in POWERS] for row in rows]
    assert all(power in POWERS for row in rows for power in row)
    return Polynomial(a, b, shares=jnp.asarray(shares), decay=decay)


TWIST, SHEAR = 0.3, 0.7


class Ring(Kicked):
    """In polar coordinates r ← r (1 + b - r²), φ ← φ + 2πa + 0.3 r² + locking r³ sin 3φ, seen as
    (x, y + 0.7 x²). The curve r = √b has the exponent ln(1 - 2b), and without locking the rotation
    number a + 0.3 b/2π."""

    locking: jax.Array = eqx.field(default=0.0, kw_only=True, converter=jnp.asarray)
    inwards = 1.0

    def kick(self, *state):
        x, y = state
        y = y - SHEAR * x**2
        square, cubic = x**2 + y**2, 3 * x**2 * y - y**3
        turn = 2 * jnp.pi * self.a + TWIST * square + self.locking * cubic
        growth, c, s = 1 + self.inwards * (self.b - square), jnp.cos(turn), jnp.sin(turn)
        x, y = growth * (c * x - s * y), growth * (s * x + c * y)
        return x, y + SHEAR * x**2


class Repelling(Ring):
    """With r ← r (1 - b + r²) the curve has the exponent ln(1 + 2b), and its inside attracts."""

    inwards = -1.0


class Alternating(Ring):
    """Two rings around (2, 0) and (-2, 0), from each of which the map of `Ring` leads to the other.
    In two cycles the motion turns twice as far."""

    def kick(self, x, y):
        centre = 2.0 * jnp.sign(x)
        x, y = super().kick(x - centre, y)
        return x - centre, y


def rotation_of(a, b):
    return a + TWIST * b / (2 * jnp.pi)
