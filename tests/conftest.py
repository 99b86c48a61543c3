"""All tests run in double precision, with short compile times."""

import gc
import signal
from pathlib import Path

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)

# Tests in these folders run optimised code, as users do. All others compile without optimisation:
# this saves a third of the time and changes only rounding.
_AS_SHIPPED = {"lanes", "robust", "experiments"}

# Checked annotations would make the many small functions of `lanes`, which generate code, three
# times slower. They have a separate test (`lanes/test_types.py`).
_PACKAGE = Path(__file__).parents[1] / "vi_jax"
_UNCHECKED = {"__init__", "lanes"}


def pytest_addoption(parser):
    parser.addoption("--annotations", action="store_true", help="check the package's annotations")


def pytest_configure(config):
    if config.option.annotations:
        names = {path.stem for path in _PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir()}
        modules = [f"vi_jax.{name}" for name in sorted(names - _UNCHECKED) if name[:2] != "__"]
        config.checked = jaxtyping.install_import_hook(modules, "beartype.beartype")


def pytest_collection_modifyitems(items):
    """Start the longest file first, so that no worker runs it alone at the end."""
    items.sort(key=lambda item: item.path.name != "test_checks.py")


# A shell makes its background processes ignore Ctrl-C, which some tests send.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# JAX's traces live long; garbage collection among them takes a tenth of the time.
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
    """Drop compiled programs before the process reaches Linux's limit of memory maps (65,530 by
    default), at which the compiler crashes. A test file needs up to 31,000."""
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > 15_000:
        jax.clear_caches()


@pytest.fixture
def compilations():
    """Return a list that grows by one entry with each compilation."""
    found = []
    note = lambda event, *_, **__: found.append(event) if "backend_compile" in event else None
    jax.monitoring.register_event_duration_secs_listener(note)
    yield found
    jax.monitoring.unregister_event_duration_listener(note)
