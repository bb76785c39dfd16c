"""One process at a time works in a folder."""

import contextlib
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
    with contextlib.ExitStack() as stack:
        number = os.open(folder / "lock", os.O_RDWR | os.O_CREAT, 0o666)
        stack.callback(os.close, number)
        try:
            if sys.platform != "win32":
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(number, 20).decode("ascii", "replace").strip()
            who = f"another process (pid {holder})" if holder.isdigit() else "another process"
            remedy = "wait for it, or choose another --out"
            raise ConfigError(f"{folder}: {who} works in this folder; {remedy}") from None
        except OSError:  # a file system without locks
            return stack.pop_all().close
        os.ftruncate(number, 0)
        os.write(number, f"{os.getpid()}\n".encode())
        return stack.pop_all().close
