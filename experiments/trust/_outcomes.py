"""Outcomes of hostile trials: refused in one line, survived with a right result, or a fault."""

import contextlib
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from typing import Any

from drt_jax.inputs import InputError

FAULTS = ("wrong", "traceback", "hang")
OUTCOMES = ("refused", "survived", *FAULTS)
# Most characters of a message, most seconds for a file.
_LONGEST, _PATIENCE = 300, 5.0
_EXAMPLES = 5


class Tally:
    """Counts of the outcomes of a kind of trial."""

    def __init__(self, kind: str):
        self._kind = kind
        self._counts = dict.fromkeys(OUTCOMES, 0)
        self._examples: list[str] = []

    def add(self, outcome: str, example: object) -> None:
        """Counts an outcome; the first few faults become examples."""
        self._counts[outcome] += 1
        if outcome in FAULTS and len(self._examples) < _EXAMPLES:
            self._examples.append(f"{outcome}: {example!r}"[:1000])

    @property
    def row(self) -> dict[str, Any]:
        """The row for results.json."""
        tried = sum(self._counts.values())
        return {"kind": self._kind, "tried": tried, **self._counts, "examples": self._examples}


class _Hang(BaseException):
    """A trial took too long."""


@contextlib.contextmanager
def _patience(seconds: float) -> Iterator[None]:
    """Raises _Hang after some seconds; in the main thread only, where signals arrive."""

    def ring(number: int, frame: Any) -> None:
        raise _Hang

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def judged(call: Callable[[], bool], seconds: float = _PATIENCE) -> tuple[str, str]:
    """Outcome and message of a call that returns True for a right result. seconds: most time."""
    try:
        with _patience(seconds), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ("survived", "") if call() else ("wrong", "the result")
    except InputError as error:
        return ("refused" if clear(str(error)) else "wrong"), str(error)
    except _Hang:
        return "hang", f"over {seconds:g} s"
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"[:_LONGEST]


def clear(message: str) -> bool:
    """True for a message of one short printable line."""
    return 0 < len(message) <= _LONGEST and message.isprintable()
