"""Comparisons are tested in float64: `.venv/bin/python -m pytest -n 0 comparisons`."""

import jax

jax.config.update("jax_enable_x64", True)
