"""Random numbers from a counter: those of a lane depend on its key and the counter alone."""

import jax.numpy as jnp
from jax.lax import shift_left, shift_right_logical, stop_gradient
from jaxtyping import Array

# Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3 (SC 2011).
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def threefry(key: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Threefry-2x32 with 20 rounds: two words from a key of two words and a counter of two."""
    keys = key[0], key[1], key[0] ^ key[1] ^ jnp.uint32(_PARITY)
    x, y = first + keys[0], second + keys[1]
    for group in range(5):
        for by in _ROTATIONS[group % 2]:
            x = x + y
            y = x ^ (shift_left(y, jnp.uint32(by)) | shift_right_logical(y, jnp.uint32(32 - by)))
        x = x + keys[(group + 1) % 3]
        y = y + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    return x, y


def normal_pair(key: Array, first: Array, second: Array, dtype) -> tuple[Array, Array]:
    """Two independent numbers of the standard normal distribution, by Box and Muller; at most 6.8
    in magnitude, as each comes from 32 bits."""
    x, y = threefry(key, first, second)
    # In the middle of each of 2³² equal parts of (0, 1).
    u = (x.astype(dtype) + jnp.asarray(0.5, dtype)) * jnp.asarray(2.0**-32, dtype)
    angle = y.astype(dtype) * jnp.asarray(2 * jnp.pi * 2.0**-32, dtype)
    # In single precision the sum may round up to 1.
    radius = jnp.sqrt(jnp.maximum(-2.0 * jnp.log(u), 0.0))
    return stop_gradient(radius * jnp.cos(angle)), stop_gradient(radius * jnp.sin(angle))
