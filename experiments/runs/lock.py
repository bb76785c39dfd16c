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
    """Take a folder for this process, and return the function that gives it back.

    The system gives it back when the process ends, however it ends. Where it has no such locks, on
    Windows and on some network file systems, nothing is locked.

    ConfigError if another process has taken the folder.
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
    """Lock an open file, and write into it who has it."""
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
