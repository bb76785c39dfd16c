"""python -m experiments._dying N SECONDS MODULE ...: kills a module as it writes.

Runs `python -m MODULE ...`. SECONDS after the N-th time that it opens, renames or removes a file in
the folder of --out, SIGKILL ends the process.
"""

import os
import runpy
import signal
import sys
import threading


def main() -> None:
    """Runs the module of the command line."""
    turn, seconds, module = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    sys.argv = [module, *sys.argv[4:]]
    folder = os.path.abspath(sys.argv[sys.argv.index("--out") + 1])
    touched = 0

    def touch(event: str, arguments: tuple) -> None:
        nonlocal touched
        if event not in ("open", "os.rename", "os.remove", "os.mkdir", "os.truncate"):
            return
        path = arguments[0]
        if isinstance(path, str | bytes) and os.fsdecode(path).startswith(folder):
            touched += 1
            if touched == turn:
                threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGKILL)).start()

    sys.addaudithook(touch)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
