"""An experiment that trains in milliseconds, for tests of the command line, run folders and
interruptions.

`python -m tests.experiments.counting` runs it like those of `experiments`.
"""

import dataclasses
import io
import os
import sys

import numpy as np

from experiments import _command
from experiments.runs.interrupt import deferred_interrupt

COLUMNS = ("loss",)
# Functions that write or lock: the moments at which a process is killed.
_WRITES = ("open", "ftruncate", "fsync", "replace", "mkdir", "unlink")


@dataclasses.dataclass(frozen=True)
class Config:
    """jobs: names of the jobs. batches: number of steps of each. result: result of the run.
    pressed: step of each job at which the process sends itself this signal."""

    jobs: tuple[str, ...] = ("one", "two")
    batches: int = 5
    result: float = 1.0
    pressed: int = 0


def run(config, run):
    """Steps of which each needs the one before, with a checkpoint after every second step."""
    found = {job: float(train(config, run, job)) for job in config.jobs}
    if run.kept("last") is None:
        run.keep("last", {"nan": config.result})
    losses = np.stack([run.metrics(job)["loss"] for job in config.jobs])
    return {"found": found, "losses": losses, **run.kept("last"), "seconds": run.seconds}


def train(config, run, job):
    step, x = run.load(job, np.ones(1), (job,), config.batches)
    x = np.asarray(x)
    with deferred_interrupt() as asked:
        while step < config.batches:
            if step == 3 and config.pressed:
                os.kill(os.getpid(), config.pressed)
            run.log(job, step, {"loss": x})
            step, x = step + 1, x / 3 + step
            if asked() or step % 2 == 0 or step == config.batches:
                run.save(job, step, x)
            if asked():
                raise KeyboardInterrupt
    return x[0]


def tables(results):
    """A table of the results."""
    return {"counting": f"found {results['found']}, {results['nan']}"}


def draw(results, figures):
    """A text file as figure."""
    (figures / "found.txt").write_text(str(results["found"]))


def at_each_write(act):
    """Calls act(k) before and after each function that writes or locks; k counts these moments."""
    count = iter(range(10**6))

    def watched(call):
        def moment(*args, **kwargs):
            act(next(count))
            try:
                return call(*args, **kwargs)
            finally:
                act(next(count))

        return moment

    return {name: watched(getattr(os, name)) for name in _WRITES}


def killed_everywhere(parent, config):
    """For every third of these moments: a run that is killed there, and a second run that continues
    in its folder, in processes that share the imports. Prints the number of moments."""

    def start(moment, *options):
        child = os.fork()
        if child:
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        sys.stdout = sys.stderr = io.StringIO()
        for name, call in at_each_write(lambda k: k == moment and os._exit(9)).items():
            setattr(os, name, call)
        code = 3
        try:
            _command.main(sys.modules[__name__], [*options])
            code = 0
        except SystemExit as ended:
            code = ended.code
        finally:
            os._exit(code)

    moment = 0
    while start(moment, "--out", f"{parent}/{moment}", "--config", config) == 9:
        if start(-1, "--out", f"{parent}/{moment}", "--resume"):
            assert start(-1, "--out", f"{parent}/{moment}", "--config", config) == 0, moment
        moment += 3
    print(moment)


if __name__ == "__main__":
    if sys.argv[1:2] == ["killed"]:
        killed_everywhere(*sys.argv[2:])
    else:
        _command.main(sys.modules[__name__])
