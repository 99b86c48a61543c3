"""`python -m vi_jax.cli`."""

from .entry import main

raise SystemExit(main())
