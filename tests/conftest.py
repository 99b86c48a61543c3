"""All tests run in double precision, and with the package's annotations checked at run time."""

import jax
import jaxtyping

jax.config.update("jax_enable_x64", True)

_hook = jaxtyping.install_import_hook("vi_jax", "beartype.beartype")
