"""The command line of an experiment: settings, run folder, results, figures, errors."""

import argparse
import datetime
import os
import pathlib
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any

import jax

import drt_jax
from drt_jax.runs import config as configs
from drt_jax.runs.folder import Run

from . import _common

# Errors raised in these folders are about the input; others are faults to be shown whole.
_OURS = (pathlib.Path(drt_jax.__file__).parent, pathlib.Path(__file__).parent)

# run(config, run) -> results; report(results, folder of figures) -> text.
Measure = Callable[[Any, Run], dict[str, Any]]
Report = Callable[[dict[str, Any], pathlib.Path], str]


def main(
    name: str,
    kind: type,
    columns: tuple[str, ...],
    run: Measure,
    report: Report,
    argv: list[str] | None = None,
) -> None:
    """Run an experiment, or with --report only draw and print the results of a run again.

    name: of the experiment. kind: the dataclass of its settings. columns: of metrics.csv. run:
    measures, and returns results for `_common.write_results`. report: draws figures from these
    results into a folder, and returns what is printed. argv: of the command line.
    """
    options = _parser(name, kind, sys.modules[run.__module__].__doc__ or "").parse_args(argv)
    # The caller, not the library, chooses the precision: optics in float64.
    jax.config.update("jax_enable_x64", True)
    _keep_programs()
    started = time.perf_counter()
    folder = None
    try:
        folder = _folder(name, options)
        if not options.report:
            config = _config(name, kind, options, folder)
            opened = Run(folder, config, columns, options.resume)
            print(f"{name}: run folder {folder}")
            _common.write_results(opened, run(config, opened))
        _show(folder, report)
    except KeyboardInterrupt:
        where = f"; go on with --resume --out {folder}" if folder else ""
        raise SystemExit(_say(f"stopped{where}", 130)) from None
    except OSError as error:
        what = f"{error.filename or folder}: {error.strerror or error}"
        remedy = "mend this and start again"
        if folder and (folder / "metrics.csv").exists():
            remedy = (
                f"the last checkpoint is whole: mend this, then go on with --resume --out {folder}"
            )
        raise SystemExit(_say(f"{what}; {remedy}", 1)) from error
    except ValueError as error:
        if not _ours(error):
            raise
        raise SystemExit(_say(str(error), 2)) from None
    print(f"done in {time.perf_counter() - started:.0f} s")


def _parser(name: str, kind: type, description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{name}",
        description=description.strip(),
        epilog="settings:\n  " + "\n  ".join(configs.describe(kind)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--config", metavar="FILE", help=f"YAML settings (default: configs/{name}.yaml)")
    change = "change settings, such as --set train.batch=8 data.root=photos"
    add("--set", metavar="KEY=VALUE", nargs="+", action="extend", default=[], help=change)
    add("--out", metavar="DIR", help=f"run folder (default: a new one in runs/{name})")
    latest = f"the latest unfinished one in runs/{name}"
    add("--resume", action="store_true", help=f"go on with the run in --out (default: {latest})")
    again = "run nothing: draw and print the results in --out again"
    add("--report", action="store_true", help=again)
    return parser


def _config(name: str, kind: type, options: argparse.Namespace, folder: pathlib.Path) -> Any:
    source = options.config or _common.ROOT / "configs" / f"{name}.yaml"
    if options.resume and not options.config:
        source = folder / "config.yaml"
        missing = f"{folder}: nothing to resume: no config.yaml in it"
        _common.require(source.is_file(), missing)
    return configs.load_config(kind, source, options.set)


def _folder(name: str, options: argparse.Namespace) -> pathlib.Path:
    if options.out:
        return pathlib.Path(options.out)
    _common.require(not options.report, "--report: name a run folder with --out")
    parent = pathlib.Path("runs") / name
    if not options.resume:
        return parent / datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    begun = sorted(path.parent for path in parent.glob("*/metrics.csv"))
    folders = [path for path in begun if not (path / "results.json").is_file()]
    remedy = "no unfinished run; name a run folder with --out"
    _common.require(bool(folders), f"nothing to resume in {parent}: {remedy}")
    return folders[-1]


def _show(folder: pathlib.Path, report: Report) -> None:
    results, figures = _common.read_results(folder), folder / "figures"
    figures.mkdir(exist_ok=True)
    print(report(results, figures))
    print(f"results in {folder / 'results.json'}, figures in {figures}")


def _keep_programs() -> None:
    """Keep compiled programs for the next run, in JAX_COMPILATION_CACHE_DIR or the user's cache."""
    if not jax.config.jax_compilation_cache_dir:
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(home) / "drt_jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def _say(message: str, code: int) -> int:
    print(f"error: {message}" if code != 130 else message, file=sys.stderr)
    return code


def _ours(error: ValueError) -> bool:
    raised = pathlib.Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    return any(raised.is_relative_to(folder) for folder in _OURS)
