"""Experiments: run one with `python -m experiments.<name>`; `--help` shows its settings."""

import contextlib
import os
import pathlib
import signal
import sys
from collections.abc import Callable
from typing import Any

# One name, `experiments.<name>`, whichever folder an experiment lies in.
__path__ += [
    str(pathlib.Path(__file__).parent / name)
    for name in ("paper", "trust", "speed", "designing", "imaging", "together")
]
# What the run folder holds if the program ends now, as text; `_command` sets it.
left: Callable[[], str] = lambda: "nothing was begun"  # noqa: E731


def _stop(number: int, frame: Any) -> None:
    """Handler of Ctrl-C: prints what the run folder holds, and ends the process. It raises no
    exception, because one could occur inside any import or get lost in a finalizer; written files
    are complete at any moment."""
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        os.write(2, f"\nstopped; {left()}\n".encode())
    os._exit(130)


# `-m` stands for the name of the module while Python looks for it. An ignored signal stays ignored.
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _stop)
