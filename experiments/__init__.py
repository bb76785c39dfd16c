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
    for name in ("paper", "trust", "speed", "designing", "imaging")
]


def _heard_early(number: int, frame: Any) -> None:
    """Ctrl-C while modules are imported, which takes seconds. Not an exception: that could come up
    in the middle of any of them."""
    with contextlib.suppress(OSError):
        os.write(2, b"\nstopped; nothing was begun\n")
    os._exit(130)


def hear(handler: Any) -> None:
    """Have Ctrl-C heard by another handler of signals, if this is the program that runs. A signal
    that is ignored stays so."""
    if _IS_PROGRAM:
        signal.signal(signal.SIGINT, handler)


# While `python -m` looks for the module to run, its name is not yet known.
_IS_PROGRAM = sys.argv[:1] == ["-m"]
_IS_PROGRAM &= signal.getsignal(signal.SIGINT) is signal.default_int_handler
hear(_heard_early)
