"""Experiments: run one with `python -m experiments.<name>`; `--help` shows its settings."""

import pathlib

# One name, `experiments.<name>`, whichever folder an experiment lies in.
__path__ += [str(pathlib.Path(__file__).parent / name) for name in ("paper", "trust", "speed")]
