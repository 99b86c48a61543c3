"""Compiled programs are kept in a folder of the user's, for this process and those it starts."""

import os

import vi_jax as vi


def keep_programs() -> None:
    folder = vi.keep_programs()
    if folder is not None:
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
