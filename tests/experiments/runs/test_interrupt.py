"""Ctrl-C is handled when the run can stop safely; a signal that is ignored stays ignored."""

import os
import signal
import subprocess
import sys
import time

import pytest

from experiments.runs.interrupt import deferred_interrupt


def press_ctrl_c():
    """KeyboardInterrupt at the place where the handler raises it; a handler runs between two
    bytecodes."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.05)


def test_first_interrupt_is_deferred_second_is_not():
    with deferred_interrupt() as asked:
        assert not asked()
        press_ctrl_c()
        assert asked()
        with pytest.raises(KeyboardInterrupt):
            press_ctrl_c()
    with pytest.raises(KeyboardInterrupt):
        press_ctrl_c()


IGNORED = """
import signal
from experiments.runs.interrupt import deferred_interrupt

handler = signal.getsignal(signal.SIGTERM)
with deferred_interrupt() as asked:
    signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN and not asked()
    signal.raise_signal(signal.SIGTERM)
    assert asked()
assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
assert signal.getsignal(signal.SIGTERM) == handler
"""


@pytest.mark.parametrize(
    "command",
    [
        [sys.executable, "-c", IGNORED],
        [*f"{sys.executable} -m pytest -n 0 -p no:cacheprovider -k deferred".split(), __file__],
    ],
    ids=["a run", "these tests"],
)
def test_an_ignored_interrupt_stays_ignored(command):
    """As when `nohup` starts a program: the run continues, and the test above neither fails nor
    waits."""
    started = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command]
    done = subprocess.run(started, timeout=100, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
