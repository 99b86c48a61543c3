"""Which version of this package is installed."""

from importlib.metadata import PackageNotFoundError, version


def installed_version() -> str:
    """That of the installed distribution; "not installed" of a copy that is only imported."""
    try:
        return version("vi-jax")
    except PackageNotFoundError:
        return "not installed"
