"""Command line of the package, `python -m drt_jax`: `show my_lens.yaml` analyses a lens; `convert`
writes a lens file in another format; `glass N-BK7` prints the data of a glass; `check` compares
results on this machine with reference values."""

import argparse
import contextlib
import gc
import os
import pathlib
import sys
import warnings
from collections.abc import Callable, Iterator

import jax

from .check import run as check
from .compilation import keep_programs
from .files.load import load_lens, load_system
from .files.write import save_lens
from .lens.lens import Lens
from .show import command as show, glasses


def _options(argv: list[str] | None) -> argparse.Namespace:
    """The parsed command line."""
    parser = argparse.ArgumentParser(prog="python -m drt_jax", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="show, convert, glass or check")

    def command(
        name: str, output: Callable[[argparse.Namespace], Iterator[show.Line]], about: str
    ) -> argparse.ArgumentParser:
        """A parser; `output` makes the lines that are printed of its options."""
        added = commands.add_parser(name, help=about, description=about)
        added.set_defaults(output=output)
        return added

    about = (
        "first-order data, spots over the field, share of light, warnings, and a sheet of analyses"
    )
    show.arguments(command("show", lambda options: show.output(options, _show_task), about))
    about = "write a lens as a file of another program; says what is not in it"
    convert = command("convert", converted, about)
    convert.add_argument("lens", help=".yaml, .zmx or .seq file, or a bundled name")
    convert.add_argument("out", type=pathlib.Path, help="file that ends in .yaml, .zmx or .seq")
    convert.add_argument("--configuration", type=int, help=show.WHICH)
    convert.add_argument("--missing", choices=("error", "warn"), default="error", help=show.MISSING)
    about = "index, Abbe number, partial dispersion, range and source of a glass, its neighbours"
    glasses.arguments(command("glass", glasses.output, about))
    about = "eleven scenes against numbers of other programs; exit status 1 if one is wrong"
    check.arguments(command("check", lambda options: check.output(options, _show_task), about))
    return parser.parse_args(argv)


def _print_line(line: show.Line) -> None:
    """Writes one line, or a row of a table, to stdout, in place of the current task."""
    _show_task("")
    if not isinstance(line, str):
        first, *numbers, last = line
        line = f"{first:>6}" + "".join(f"{cell:>15}" for cell in numbers) + f"   {last}".rstrip()
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _show_task(what: str) -> None:
    """Shows the current task on the last line of a terminal; writes nothing if stderr is not a
    terminal.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{what}")
        sys.stderr.flush()


def converted(options: argparse.Namespace) -> Iterator[str]:
    """Writes a lens in another format. Warnings say which data the new file leaves out."""
    paths = options.lens, options.out
    read, write = (pathlib.Path(path).suffix.lower() in show.OTHERS for path in paths)
    load, given = load_system if read else load_lens, (options.lens, options.missing)
    whole = read and write and options.configuration is None  # with all configurations
    first = load(*given, 1 if whole else options.configuration)
    lens, count = (first, 1) if isinstance(first, Lens) else (first.lens, first.configurations)
    found = [first, *(load(*given, k + 1) for k in range(1, count if whole else 1))]
    save_lens(found, options.out)
    what = f"{len(found)} configurations, " if found[1:] else ""
    yield f"{lens.name or 'the lens'}, {what}{lens.count} surfaces, is written to {options.out}"


@contextlib.contextmanager
def _warnings_on_stdout() -> Iterator[None]:
    """Prints every warning as a line, once."""
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # each once
        warnings.showwarning = lambda message, *_, **__: _print_line(f"  ! {message}")
        yield


def set_up() -> None:
    """Changes settings that a library must not change.

    It enables float64, keeps compiled programs if there is a folder for them, and makes garbage
    collection rarer: tracing makes many objects that stay, and collection took a tenth of the time.
    """
    gc.set_threshold(200_000, 20, 20)
    jax.config.update("jax_enable_x64", True)
    with contextlib.suppress(OSError):
        keep_programs()


def main(argv: list[str] | None = None) -> None:
    """Runs the command line. An error prints one line; exit status 2, 1 (file) or 130 (Ctrl-C)."""
    try:
        set_up()
        options = _options(argv)
        with _warnings_on_stdout():
            for line in options.output(options):
                _print_line(line)
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        raise SystemExit(130) from None
    except ValueError as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(2) from None
    except BrokenPipeError:  # the reader, such as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"error: {place}{error.strerror}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
