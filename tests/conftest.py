"""All tests run in double precision; what takes most of their time, compiling, is kept short."""

import gc
import signal
from pathlib import Path

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)

# These rooms run the code that users run; in the others programs are compiled without optimisation,
# which takes a third of the time off and changes rounding only.
_AS_SHIPPED = {"lanes", "robust", "experiments"}

# The lanes' many small functions, which write a program's text, would take three times as long with
# checks of annotations; they have a test of their own (`lanes/test_types.py`).
_PACKAGE = Path(__file__).parents[1] / "vi_jax"
_UNCHECKED = {"__init__", "lanes"}


def pytest_addoption(parser):
    parser.addoption(
        "--annotations", action="store_true", help="check the package's annotations at run time"
    )


def pytest_configure(config):
    if config.option.annotations:
        names = {path.stem for path in _PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
        modules = [f"vi_jax.{name}" for name in sorted(names - _UNCHECKED) if name[:2] != "__"]
        config.checked = jaxtyping.install_import_hook(modules, "beartype.beartype")


def pytest_collection_modifyitems(items):
    """The longest file comes first, so that no worker is left with it in the end."""
    items.sort(key=lambda item: item.path.name != "test_checks.py")


# A shell lets what it runs in the background ignore Ctrl-C, which some tests press.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What JAX traces lives long, and collecting garbage among it takes a tenth of the time.
gc.set_threshold(200_000, 20, 20)

_MAPS = Path("/proc/self/maps")


@pytest.fixture(scope="module", autouse=True)
def _optimised_as_needed(request):
    shipped = request.path.parent.name in _AS_SHIPPED
    jax.config.update("jax_disable_most_optimizations", not shipped)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(scope="module", autouse=True)
def _room_for_programs():
    """Compiled programs go before they use up the memory maps that Linux grants a process (65,530
    by default), beyond which the compiler dies; a file of tests needs up to 31,000."""
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > 15_000:
        jax.clear_caches()


@pytest.fixture
def compilations():
    """A list of the programs that are compiled meanwhile."""
    found = []
    note = lambda event, *_, **__: found.append(event) if "backend_compile" in event else None
    jax.monitoring.register_event_duration_secs_listener(note)
    yield found
    jax.monitoring.unregister_event_duration_listener(note)
