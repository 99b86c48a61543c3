"""Colours of regimes are distinct with any colour vision."""

import itertools

import numpy as np
from matplotlib.colors import to_rgb
from vi_jax.plot.colors import IRREGULAR, MORE_IMPACTS, NOT_COMPUTED, PERIODS, color_of, paler

# Machado, Oliveira and Fernandes 2009, on linear light, at full severity.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
         [0.004733, 0.691367, 0.303900]]
    ),
}  # fmt: skip


def seen(color, vision):
    """Return 100 times the Oklab coordinates of a colour as seen with this vision."""
    rgb = np.array(to_rgb(color))
    light = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    cones = np.array(
        [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
         [0.0883024619, 0.2817188376, 0.6299787005]]
    ) @ np.clip(vision @ light, 0, 1)  # fmt: skip
    return 100 * np.array(
        [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
         [0.0259040371, 0.7827717662, -0.8086757660]]
    ) @ np.cbrt(cones)  # fmt: skip


def least(colors):
    return min(
        np.linalg.norm(seen(a, vision) - seen(b, vision))
        for a, b in itertools.combinations(colors, 2)
        for vision in VISIONS.values()
    )


def test_regimes_are_distinct():
    # For comparison: green and red of equal lightness have a distance of 1.2.
    assert least([*PERIODS, MORE_IMPACTS, *IRREGULAR.values(), NOT_COMPUTED]) > 5
    assert least([*PERIODS[:4], MORE_IMPACTS, *IRREGULAR.values(), NOT_COMPUTED]) > 7


def test_a_regime_has_one_colour():
    assert color_of(1) == color_of(1, 1) == PERIODS[0] and color_of(64, 3) == PERIODS[-1]
    assert color_of(1, 0) == paler(PERIODS[0])
    assert color_of(2, 1) == PERIODS[1] != color_of(2, 2) == color_of(2, 3) == MORE_IMPACTS
    assert color_of(-1) == "#1a1a1a"
