"""Files that are there whole or not at all."""

import os
import tempfile
from pathlib import Path


def write_whole(path: str | Path, content: str | bytes) -> None:
    """Write a file beside its place and then rename it, so that a full disk or an interrupt leaves
    what was there before. **Raises:** `OSError`."""
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"Argument `path` must lie in a folder that exists, but got {str(path)!r}."
        )
    # A link keeps leading to its file, and a pipe or a device is written to as it is.
    path = path.resolve() if path.is_symlink() else path
    content = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        path.write_bytes(content)
        return
    mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
    handle, beside = tempfile.mkstemp(prefix=f".{path.name[:40]}.", dir=path.parent)
    try:
        with open(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(beside, mode)
        os.replace(beside, path)
    except BaseException:
        Path(beside).unlink(missing_ok=True)
        raise


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask
