"""Lenses from and to files."""
