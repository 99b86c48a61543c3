"""The command line as `python -m vi_jax`."""

from .cli import main

raise SystemExit(main())
