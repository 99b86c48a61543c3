"""The README's moving picture is small, moves, and shows what is simulated."""

import jax
import numpy as np
import pytest
from moving_picture import CYCLES, FRAMES, GRID, TARGET, simulated
from PIL import Image


def test_it_is_small_and_moves():
    assert TARGET.stat().st_size < 200_000
    with Image.open(TARGET) as picture:
        assert picture.n_frames == CYCLES * FRAMES + 1  # pyright: ignore
        first = np.asarray(picture.convert("RGB"))
        picture.seek(picture.n_frames // 2)  # pyright: ignore
        assert (np.asarray(picture.convert("RGB")) != first).any()


@pytest.mark.slow
def test_it_shows_what_is_simulated():
    sections, settled, rest = simulated()
    assert sections.shape == (GRID**2, CYCLES + 1, 2)
    assert {*settled} == {0, 1}
    # A start on the stop or inside; the machine that is drawn begins at rest.
    assert sections[..., 0].max() <= 2.0
    assert rest.samples is not None
    state = jax.tree_util.tree_map(lambda x: float(x[0]), rest.samples.state)
    assert (state.Y, state.V) == (0.0, 0.0)
