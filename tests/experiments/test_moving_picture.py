"""The README's animation."""

import jax
import numpy as np
import pytest
from moving_picture import CYCLES, FRAMES, GRID, TARGET, simulated
from PIL import Image


def test_the_animation_is_small_and_moves():
    assert TARGET.stat().st_size < 200_000
    with Image.open(TARGET) as picture:
        assert picture.n_frames == CYCLES * FRAMES + 1  # pyright: ignore
        first = np.asarray(picture.convert("RGB"))
        picture.seek(picture.n_frames // 2)  # pyright: ignore
        assert (np.asarray(picture.convert("RGB")) != first).any()


@pytest.mark.slow
def test_the_animation_shows_both_basins():
    sections, settled, rest = simulated()
    assert sections.shape == (GRID**2, CYCLES + 1, 2)
    assert {*settled} == {0, 1}
    # No start lies beyond the stop; the machine in the animation begins at rest.
    assert sections[..., 0].max() <= 2.0
    assert rest.samples is not None
    state = jax.tree_util.tree_map(lambda x: float(x[0]), rest.samples.state)
    assert (state.Y, state.V) == (0.0, 0.0)
