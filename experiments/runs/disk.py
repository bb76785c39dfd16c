"""Files of a run: atomic replacement of files, arrays with a checksum, and the lock of a folder."""

import contextlib
import hashlib
import io
import json
import os
import pathlib
import secrets
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .config import ConfigError

if sys.platform != "win32":
    import fcntl

_SCRATCH = ".drt_jax.partial"


def replace(path: pathlib.Path, content: bytes) -> None:
    """Replaces a file atomically: at every moment it has the old content (or does not exist) or the
    new content.

    path: path of the file; its folder is created.
    content: the new content.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(secrets.token_hex(8) + _SCRATCH)  # a name for this call alone
    try:
        with open(scratch, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


def sweep(folder: pathlib.Path) -> None:
    """Removes temporary files of processes that were killed in `replace`."""
    for scratch in folder.glob("*" + _SCRATCH):
        scratch.unlink(missing_ok=True)


def packed(about: dict[str, Any], leaves: Sequence[np.ndarray]) -> bytes:
    """Arrays and their description as the content of an .npz file, with a checksum of both.

    about: description, written as JSON. leaves: the arrays.
    """
    text, file = json.dumps(about), io.BytesIO()
    entries: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
    np.savez(file, about=np.array(text), checksum=np.array(_checksum(text, leaves)), **entries)
    return file.getvalue()


def unpacked(content: bytes) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The arguments of `packed`. ValueError, with the reason, if the content is damaged or is not a
    result of `packed`."""
    try:
        with np.load(io.BytesIO(content)) as saved:
            text, checksum = str(saved["about"]), str(saved["checksum"])
            leaves = [saved[f"leaf{i}"] for i in range(len(saved.files) - 2)]
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError("is no checkpoint, or a damaged one") from error
    if _checksum(text, leaves) != checksum:
        raise ValueError("is damaged: its checksum is another")
    return json.loads(text), leaves


def finite(leaves: Sequence[np.ndarray]) -> bool:
    """True if all numbers of arrays are finite."""
    numbers = (leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.inexact))
    return all(bool(np.all(np.isfinite(leaf))) for leaf in numbers)


def _checksum(about: str, leaves: Sequence[np.ndarray]) -> str:
    sums = hashlib.sha256(about.encode())
    for leaf in leaves:
        sums.update(f"{leaf.dtype.str}{leaf.shape}".encode())
        sums.update(leaf.tobytes())
    return sums.hexdigest()


@contextlib.contextmanager
def locked(folder: pathlib.Path) -> Iterator[None]:
    """Keeps other processes out of a folder.

    The operating system removes the lock when the process ends, also if it is killed. On Windows
    and on some network file systems, which have no such locks, nothing is locked. ConfigError if
    another process has locked the folder.
    """
    number = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            if sys.platform != "win32":
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(number, 20).decode("ascii", "replace").strip()
            who = f"another process (pid {holder})" if holder.isdigit() else "another process"
            remedy = "wait for it, or choose another --out"
            raise ConfigError(f"{folder}: {who} works in this folder; {remedy}") from None
        except OSError:
            pass  # a file system without locks
        else:
            os.ftruncate(number, 0)
            os.write(number, f"{os.getpid()}\n".encode())
        yield
    finally:
        os.close(number)
