"""A call in a second process."""

import math
import time

import jax.numpy as jnp
import pytest
from vi_jax.paper.beside import beside


def test_result_comes_back_in_the_same_precision():
    with beside(math.hypot, 3.0, 4.0) as length, beside(jnp.zeros, 2) as zeros:
        assert length() == 5.0
        assert zeros().dtype == jnp.zeros(2).dtype


def test_what_fails_there_is_raised_here():
    with beside(math.sqrt, -1.0) as root, pytest.raises(ValueError, match="math domain"):
        root()


def test_ends_with_its_block():
    begin = time.monotonic()
    with beside(time.sleep, 60.0):
        pass
    assert time.monotonic() - begin < 30
