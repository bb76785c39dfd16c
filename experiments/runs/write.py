"""A file that is written whole or not at all."""

import os
import pathlib
import secrets

_SCRATCH = ".drt_jax.partial"


def replace(path: pathlib.Path, content: bytes) -> None:
    """Writes a file in one step: at every moment there is the old one (or none) or the new one.

    path: path of the file; its folder is created.
    content: the whole content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(secrets.token_hex(8) + _SCRATCH)  # of this call alone
    try:
        with open(scratch, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def sweep(folder: pathlib.Path) -> None:
    """Removes what a process killed in `replace` left in a folder."""
    for scratch in folder.glob("*" + _SCRATCH):
        scratch.unlink(missing_ok=True)
