"""Ctrl-C is deferred until the run can stop safely."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def deferred_interrupt(notify: Callable[[], None] = lambda: None) -> Iterator[Callable[[], bool]]:
    """Defers the first Ctrl-C (or SIGTERM): yields a function that returns True after it was
    received. A second one interrupts at once. An ignored signal, such as SIGINT under `nohup`, is
    still ignored.

    notify: called at the first signal.
    """
    asked = False
    # Only the main thread may handle signals; None: a handler from outside Python.
    main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, signal.SIGTERM) if main else ()
    previous = {n: h for n in numbers if (h := signal.getsignal(n)) not in (None, signal.SIG_IGN)}

    def ask(number: int, frame: Any) -> None:
        nonlocal asked
        asked = True
        signal.signal(number, previous[signal.Signals(number)])
        notify()

    for number in previous:
        signal.signal(number, ask)
    try:
        yield lambda: asked
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
