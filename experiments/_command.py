"""The command line of an experiment: settings, run folder, results, figures, errors."""

import argparse
import dataclasses
import datetime
import pathlib
import sys
import time
import traceback
from typing import Any

import jax

import drt_jax
import experiments
from drt_jax import show
from drt_jax.__main__ import set_up

from . import _common, _sharing
from .runs import config as configs
from .runs.folder import Run, begun

# Errors that are raised in these folders are about the input; others are bugs, shown with a
# traceback.
_OURS = (pathlib.Path(drt_jax.__file__).parent, pathlib.Path(__file__).parent)


def _left(folder: pathlib.Path | None) -> tuple[str, str]:
    """Two texts: the state of a run folder if the command ends now, and how to continue, "" if the
    run has not started. folder: None if it is not known yet."""
    if not (folder and (folder / "config.yaml").is_file()):
        return "nothing was begun", ""
    if (folder / "results.json").is_file():
        return "the results are whole", f"draw them with --report --out {folder}"
    return "what it wrote is whole", f"go on with --resume --out {folder}"


def main(experiment: Any, argv: list[str] | None = None) -> None:
    """Runs an experiment; with --report only draws and prints the results of a run again.

    experiment: a module with `Config`, the dataclass of its settings; `COLUMNS` of metrics.csv, if
        it trains, and `columns` of its settings for further ones; `run(config, run)`, which returns
        the results for `Run.finish`; `tables(results)`, which are printed; and
        `draw(results, folder)`, which draws the figures.
    argv: arguments of the command line.
    """
    name, folder = experiment.__spec__.name.split(".")[-1], None
    experiments.left = lambda: "; ".join(filter(None, _left(folder)))
    try:
        options = _parser(name, experiment).parse_args(argv)
        if options.processes:
            _sharing.join(options.processes)
        set_up()
        folder = _folder(name, options)
        bad = _do(name, experiment, options, folder)
        if not bad:
            return
        others = f" and {len(bad) - 3} others" if len(bad) > 3 else ""
        what = ", ".join(bad[:3]) + others
        code, message = 1, f"error: not finite, null in {folder}/results.json: {what}"
    except KeyboardInterrupt:
        code, message = 130, f"stopped; {experiments.left()}"
    except OSError as error:
        what, remedy = _left(folder)
        wrong = f"{error.filename or folder}: {error.strerror or error}"
        code, message = 1, f"error: {wrong}; {what}: mend this, then {remedy or 'start again'}"
    except jax.errors.JaxRuntimeError:
        if jax.process_count() == 1:
            raise
        _sharing.leave(f"error: another process of the run has ended; {experiments.left()}", 1)
    except ValueError as error:
        raised = pathlib.Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        if not any(raised.is_relative_to(ours) for ours in _OURS):
            raise
        code, message = 2, f"error: {error}"
    print(message, file=sys.stderr)
    raise SystemExit(code)


def _do(name: str, experiment: Any, options: argparse.Namespace, folder: pathlib.Path) -> list[str]:
    """Does the work of `main` in a run folder, and returns the names of results that are not
    finite."""
    started = time.perf_counter()
    if not options.report:
        with _sharing.own_folder(folder, options.resume) as own:
            config = _config(name, experiment.Config, options, own)
            columns = getattr(experiment, "COLUMNS", ()), getattr(config, "columns", ())
            with Run(own, config, sum(columns, ()), options.resume) as run:
                print(f"{name}: run folder {own}")
                run.finish(experiment.run(config, run))
        if own != folder:  # only the first process continues
            return []
    results, figures = _common.read_results(folder), folder / "figures"
    figures.mkdir(exist_ok=True)
    tables = experiment.tables(results)
    print("\n\n".join(tables.values()))
    experiment.draw(results, figures)
    report, settings = folder / "report.html", folder / "config.yaml"
    pictures = {p.stem.replace("_", " "): p for p in sorted(figures.glob("*.png"))}
    parts = tables | pictures | ({"Settings": settings.read_text()} if settings.is_file() else {})
    page = show.page(name, [*parts.items()])
    report.write_text(page, encoding="utf-8")  # like the figures, drawn again by --report
    print(f"results in {folder / 'results.json'}, all on one page in {report}")
    print(f"done in {time.perf_counter() - started:.0f} s")
    return results.get("not_finite", [])


def _parser(name: str, experiment: Any) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments.{name}",
        description=experiment.__doc__.strip(),
        epilog="settings:\n  " + "\n  ".join(configs.describe(experiment.Config)),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--config", metavar="FILE", help=f"YAML settings (default: configs/{name}.yaml)")
    change = "change settings, such as --set train.batch=8 data.root=photos"
    add("--set", metavar="KEY=VALUE", nargs="+", action="extend", default=[], help=change)
    add("--out", metavar="DIR", help=f"run folder (default: a new one in runs/{name})")
    latest = f"the latest unfinished one in runs/{name}"
    add("--resume", action="store_true", help=f"go on with the run in --out (default: {latest})")
    add("--processes", metavar="WHICH", help=_sharing.HELP)
    again = "run nothing: draw and print the results in --out again"
    add("--report", action="store_true", help=again)
    return parser


def _config(name: str, kind: type, options: argparse.Namespace, folder: pathlib.Path) -> Any:
    source = options.config or _common.CONFIGS / f"{name}.yaml"
    if options.resume and not options.config:
        source = folder / "config.yaml"
        _common.require(source.is_file(), f"{folder}: nothing to resume: no config.yaml in it")
    config = configs.load_config(kind, source, options.set)
    lens = getattr(config, "lens", "")
    known = _common.BASE / lens  # for a command that starts elsewhere
    elsewhere = lens and not pathlib.Path(lens).exists() and known.is_file()
    return dataclasses.replace(config, lens=str(known)) if elsewhere else config


def _folder(name: str, options: argparse.Namespace) -> pathlib.Path:
    if options.out:
        return pathlib.Path(options.out)
    _common.require(not options.report, "--report: name a run folder with --out")
    parent = pathlib.Path("runs") / name
    if not options.resume:
        return parent / datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    runs = [path.parent for path in parent.glob("*/config.yaml") if begun(path.parent)]
    folders = sorted(path for path in runs if not (path / "results.json").is_file())
    remedy = "no unfinished run; name a run folder with --out"
    _common.require(bool(folders), f"nothing to resume in {parent}: {remedy}")
    return folders[-1]
