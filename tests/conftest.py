"""All tests run in double precision, the default ones with annotations checked at run time."""

import gc
from pathlib import Path

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)

# The lanes' many small functions, which write a program's text, would take three times as long;
# they are checked in a process of their own (`lanes/test_types.py`).
_PACKAGE = Path(__file__).parents[1] / "vi_jax"
_MODULES = sorted(
    {path.name.removesuffix(".py") for path in _PACKAGE.iterdir() if path.name[0] != "."}
    - {"__pycache__", "__init__", "py", "lanes"}
)


def pytest_configure(config):
    """Check annotations, but not where only longer tests are run: these go through the same code
    with more numbers, and checks take two fifths of their time (40 for 29 s of a processor, for the
    friction and the quantities of orbits)."""
    if config.option.markexpr not in ("slow", "exhaustive", "slow and not exhaustive"):
        modules = [f"vi_jax.{name}" for name in _MODULES]
        config.checked = jaxtyping.install_import_hook(modules, "beartype.beartype")


# What JAX traces lives long, and collecting garbage among it takes a tenth of the time.
gc.set_threshold(200_000, 20, 20)

_MAPS = Path("/proc/self/maps")


@pytest.fixture(scope="module", autouse=True)
def _room_for_programs():
    """Compiled programs go before they use up the memory maps that Linux grants a process (65,530
    by default), beyond which the compiler dies; a file of tests needs up to 31,000."""
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > 15_000:
        jax.clear_caches()
