"""The command `drt-jax`: `drt-jax focus` is `python -m experiments.focus`, and so for every
experiment; `drt-jax show LENS`, `convert`, `glass` and `check` are those of `python -m drt_jax`.
"""

import pkgutil
import runpy
import sys

import drt_jax.__main__
import experiments

from . import _common

_ABOUT = """usage: drt-jax COMMAND ...

  show LENS      what a lens is: focal lengths, spots, what clips it, a sheet of analyses
  convert A B    a lens file of Zemax, CODE V or ours in another format
  glass NAME     what a glass is, and which others lie next to it
  check          whether this machine computes what it should: begin here, and bug reports, too

experiments, each with --help:
"""


def names() -> list[str]:
    """The experiments that have default settings."""
    every = (module.name for module in pkgutil.iter_modules(experiments.__path__))
    return [name for name in every if (_common.CONFIGS / f"{name}.yaml").is_file()]


def main() -> None:
    """Run what the command line names."""
    command, *words = sys.argv[1:] or ["--help"]
    if command in names():
        sys.argv = [f"drt-jax {command}", *words]
        runpy.run_module(f"experiments.{command}", run_name="__main__", alter_sys=True)
    elif command in ("-h", "--help"):
        sys.stdout.write(_ABOUT + "".join(f"  {name}\n" for name in names()))
    else:
        drt_jax.__main__.main()


if __name__ == "__main__":
    main()
