"""Where the time of the tests goes: `pytest --times FILE` writes a table of one run, by test file.

Columns: processor time, and the times that JAX spends on tracing, lowering and compiling (clock
times, so longer where processes compete); programs that were compiled, and that came from the
folder of compiled programs instead. All in seconds or counts, sums over the tests of a file.
"""

import collections
import pathlib
import time
from typing import Any

import jax
import pytest

_EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
    "/jax/compilation_cache/cache_retrieval_time_sec": "load",
}
COLUMNS = ("tests", "cpu", "trace", "lower", "compile", "programs", "loaded")


class Times:
    """Pytest plugin that adds up the times of a run; each test sends its times to the process that
    reports."""

    def __init__(self, file: str):
        self.file = pathlib.Path(file)
        self.now: collections.Counter[str] = collections.Counter()
        self.files: dict[str, collections.Counter[str]] = {}
        self.ended: list[tuple[float, float]] = []
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, seconds: float, **_: Any) -> None:
        """Counts an event that ends now, without the events inside it: tracing a program traces
        others."""
        if name := _EVENTS.get(event):
            start, within = time.perf_counter() - seconds, 0.0
            while self.ended and self.ended[-1][0] > start:
                within += self.ended.pop()[1]
            self.ended.append((start, seconds))
            self.now[name] += max(seconds - within, 0)
            self.now["programs"] += name == "compile"
            self.now["loaded"] += name == "load"

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item):
        """Times one test with its fixtures."""
        self.now.clear()
        self.ended.clear()
        self._start = time.process_time()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo):
        """Gives the last report of a test its times."""
        report = yield
        if report.when == "teardown":
            own = {**self.now, "cpu": time.process_time() - self._start, "tests": 1}
            report.user_properties.append(("times", own))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Adds the times of a test to its file."""
        own = dict(report.user_properties).get("times") if report.when == "teardown" else None
        if own is not None:
            found = self.files.setdefault(report.nodeid.split("::")[0], collections.Counter())
            found.update(own)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Writes the table, the longest file first."""
        if hasattr(session.config, "workerinput"):
            return
        total: collections.Counter[str] = collections.Counter()
        for own in self.files.values():
            total.update(own)
        rows = sorted(self.files.items(), key=lambda row: -row[1]["cpu"])
        lines = ["file\t" + "\t".join(COLUMNS)]
        for name, own in [("all", total), *rows]:
            lines.append("\t".join([name, *(f"{own[column]:.0f}" for column in COLUMNS)]))
        self.file.write_text("\n".join(lines) + "\n")
