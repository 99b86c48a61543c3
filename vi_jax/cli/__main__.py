"""`python -m vi_jax.cli`."""

from .command import main

raise SystemExit(main())
