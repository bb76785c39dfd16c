"""One process at a time works in a folder."""

import functools
import os
import pathlib
import sys
from collections.abc import Callable

from .config import ConfigError

if sys.platform != "win32":
    import fcntl


def lock(folder: pathlib.Path) -> Callable[[], None]:
    """Locks a folder for this process, and returns the function that unlocks it.

    The system unlocks it when the process ends, however it ends. Windows and some network file
    systems have no such locks: nothing is locked there. ConfigError if another process has locked
    the folder.
    """
    number = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
    try:
        if sys.platform != "win32":
            _claim(number, folder)
    except BaseException:
        os.close(number)
        raise
    return functools.partial(os.close, number)


def _claim(number: int, folder: pathlib.Path) -> None:
    """Locks an open file and writes the process into it."""
    try:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(number, 20).decode("ascii", "replace").strip()
        who = f"another process (pid {holder})" if holder.isdigit() else "another process"
        remedy = "wait for it, or choose another --out"
        raise ConfigError(f"{folder}: {who} works in this folder; {remedy}") from None
    except OSError:  # a file system without locks
        return
    os.ftruncate(number, 0)
    os.write(number, f"{os.getpid()}\n".encode())
