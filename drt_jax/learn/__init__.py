"""The network and its training; no optics formula in here."""
