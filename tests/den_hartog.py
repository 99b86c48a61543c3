"""Non-stop motion of a harmonically forced oscillator with dry friction, in closed form."""

import numpy as np


def den_hartog(r, f):
    """Return the amplitude of the non-stop motion and the largest friction at which it exists.
    Mass, stiffness and force amplitude are 1 (Den Hartog, Transactions of the ASME 53, 1931)."""
    response = 1 / (1 - r * r)
    loss = np.sin(np.pi / r) / (r * (1 + np.cos(np.pi / r)))
    t = np.linspace(1e-4, np.pi - 1e-4, 200001)
    bends = (r * np.sin(t / r) + loss * r * r * (np.cos(t) - np.cos(t / r))) / np.sin(t)
    amplitude = np.sqrt(np.maximum(response**2 - (f * loss) ** 2, 0))
    return amplitude, np.abs(response) / np.hypot(loss, max(1.0, bends.max()) / r**2)
