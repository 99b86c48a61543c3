"""All tests run in double precision, and with the package's annotations checked at run time."""

import jax
import jaxtyping
import pytest

jax.config.update("jax_enable_x64", True)

_hook = jaxtyping.install_import_hook("vi_jax", "beartype.beartype")


@pytest.fixture(scope="module", autouse=True)
def _programs_of_one_file():
    """A file's compiled programs go with it: thousands in one process use up the memory maps that
    Linux grants it (`vm.max_map_count`), and the compiler dies."""
    yield
    jax.clear_caches()
