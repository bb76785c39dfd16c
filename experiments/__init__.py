"""Experiments: run one with `python -m experiments.<name>`; `--help` shows its settings."""
