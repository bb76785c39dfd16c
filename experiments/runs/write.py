"""A file that is written whole or not at all."""

import os
import pathlib
import secrets

_SCRATCH = ".drt_jax.partial"


def replace(path: pathlib.Path, content: bytes) -> None:
    """Write a file; at every moment there is the old one (or none), or the new one.

    path: of the file, whose folder is made if need be. content: all of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(secrets.token_hex(8) + _SCRATCH)  # none that another may write
    try:
        with open(scratch, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def sweep(folder: pathlib.Path) -> None:
    """Remove what a process that was killed in `replace` left in a folder."""
    for scratch in folder.glob("*" + _SCRATCH):
        scratch.unlink(missing_ok=True)
