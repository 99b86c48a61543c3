"""`python -m vi_jax.cli`."""

import sys

from .entry import main

sys.exit(main())
