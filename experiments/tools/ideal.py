"""The paper's machine with an ideal drive and the stop at two crank radii: its closed forms."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

GAP = 2.0
_SIZE = 512  # points in one call: one program for any number


def machine(zeta: Any, k: Any, xi: Any) -> vi.Scene:
    """Return the machine at a frequency ratio, a restitution and a damping ratio."""
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=GAP, damping_ratio=xi)


# Without optimisation it compiles in half of the time, and it still runs within milliseconds.
@partial(jax.jit, static_argnames="cycles", compiler_options={"xla_backend_optimization_level": 0})
def _closed_forms(points: jax.Array, *, cycles: int) -> vi.ClosedFormOrbits:
    return jax.vmap(lambda x: vi.closed_form_orbits(machine(*x), cycles=cycles))(points)


def closed_forms(points: np.ndarray, cycles: int) -> vi.ClosedFormOrbits:
    """Return the motions with one impact in `cycles` cycles, at most two at each point.

    **Arguments:** points (ζ, k, ξ) of shape `(n, 3)`; the number of cycles. The fields of the
    result are NumPy arrays whose first dimension is `n`.
    """
    full = np.concatenate([points, np.repeat(points[-1:], -len(points) % _SIZE, axis=0)])
    parts = [_closed_forms(jnp.asarray(part), cycles=cycles) for part in full.reshape(-1, _SIZE, 3)]
    return jax.tree.map(lambda *a: np.concatenate(a)[: len(points)], *parts)


def vibration(zeta: Any, xi: Any) -> Any:
    """Return the complex amplitude 1/(1 - ζ² + 2iξζ) of the steady vibration without impacts."""
    return 1 / (1 - zeta**2 + 2j * xi * zeta)


def births(xi: Any) -> list[Any]:
    """Return the smaller and the larger ζ at which that vibration just reaches the stop."""
    middle, half = 1 - 2 * xi**2, np.sqrt((1 - 2 * xi**2) ** 2 - 1 + GAP**-2)
    return [np.sqrt(middle + s * half) for s in (-1, 1)]
