"""Experiments: run one with `python -m experiments.<name>`; `--help` shows its settings."""

import contextlib
import os
import pathlib
import signal
import sys
from typing import Any

# One name, `experiments.<name>`, whichever folder an experiment lies in.
__path__ += [
    str(pathlib.Path(__file__).parent / name)
    for name in ("paper", "trust", "speed", "designing", "imaging", "together")
]


def _heard_early(number: int, frame: Any) -> None:
    """Ctrl-C during imports, which take seconds. Not an exception, which could rise inside any
    module."""
    with contextlib.suppress(OSError):
        os.write(2, b"\nstopped; nothing was begun\n")
    os._exit(130)


def hear(handler: Any) -> None:
    """Sets the handler of Ctrl-C, if this is the program that runs. An ignored signal stays
    ignored."""
    if _IS_PROGRAM:
        signal.signal(signal.SIGINT, handler)


# `-m` stands for the name of the module while Python looks for it.
_IS_PROGRAM = sys.argv[:1] == ["-m"]
_IS_PROGRAM &= signal.getsignal(signal.SIGINT) is signal.default_int_handler
hear(_heard_early)
