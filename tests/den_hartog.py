"""A harmonically forced oscillator with dry friction that never stops, in closed form."""

import numpy as np


def den_hartog(r, f):
    """Amplitude of the motion that never stops, and the friction up to which there is one; both
    for a force of amplitude one on a body of unit mass and spring (Den Hartog, Transactions of the
    ASME 53, 1931)."""
    response = 1 / (1 - r * r)
    loss = np.sin(np.pi / r) / (r * (1 + np.cos(np.pi / r)))
    t = np.linspace(1e-4, np.pi - 1e-4, 200001)
    bends = (r * np.sin(t / r) + loss * r * r * (np.cos(t) - np.cos(t / r))) / np.sin(t)
    amplitude = np.sqrt(np.maximum(response**2 - (f * loss) ** 2, 0))
    return amplitude, np.abs(response) / np.hypot(loss, max(1.0, bends.max()) / r**2)
