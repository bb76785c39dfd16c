"""Experiments: run one with `python -m experiments.<name>`; `--help` shows its settings."""

import contextlib
import os
import pathlib
import signal
import sys
from typing import Any

# One name, `experiments.<name>`, whichever folder an experiment lies in.
__path__ += [str(pathlib.Path(__file__).parent / name) for name in ("paper", "trust", "speed")]


def _heard_early(number: int, frame: Any) -> None:
    """Ctrl-C while modules are imported, which takes seconds. Not an exception: that could come up
    in the middle of any of them."""
    with contextlib.suppress(OSError):
        os.write(2, b"\nstopped; nothing was begun\n")
    os._exit(130)


def imported() -> None:
    """All is imported: from here on Ctrl-C is a KeyboardInterrupt."""
    if signal.getsignal(signal.SIGINT) is _heard_early:
        signal.signal(signal.SIGINT, signal.default_int_handler)


# While `python -m` looks for the module to run, its name is not yet known. A signal that is ignored
# stays so.
if sys.argv[:1] == ["-m"] and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _heard_early)
