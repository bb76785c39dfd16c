"""Lenses from files: the bundled ones, and your own in YAML and in the formats of others."""

import pathlib
from collections.abc import Mapping

import jax

from ..inputs import InputError, read_yaml, shown
from ..lens.lens import Lens
from .entry import LensError
from .record import Missing, Record
from .seq import read_seq
from .specs import build_lens
from .system import System, Use, lens_of, system_of
from .zmx import read_zmx

_BUNDLED = pathlib.Path(__file__).resolve().parents[1] / "lens" / "catalogue" / "lenses"
_READERS = {".zmx": read_zmx, ".seq": read_seq}


def lens_names() -> list[str]:
    """Names of the bundled prescriptions."""
    return sorted(path.stem for path in _BUNDLED.glob("*.yaml"))


def load_lens(source: str | pathlib.Path | Mapping, missing: Missing = "error") -> Lens:
    """Read a lens.

    The arrays have JAX's default floating dtype: float64 where the caller enabled it. LensError
    for a missing file, an unknown key or glass, or numbers that make no lens, with the line.

    source: a bundled name (see `lens_names`), the path of a YAML prescription of at most 1 MB or
        of a Zemax `.zmx` or CODE V `.seq` file, see `load_system`, or a mapping with the keys of a
        prescription.
    missing: as of `load_system`.
    """
    with jax.core.eval_context():  # a lens loaded inside a jitted function is a constant
        if isinstance(source, Mapping):
            return build_lens(dict(source))
        path = pathlib.Path(source)
        if path.suffix.lower() in _READERS:
            record, use = _read(path, missing)
            lens = lens_of(record, use)
            record.say()
            return lens
        if path.suffix.lower() not in (".yaml", ".yml"):
            if str(source) not in lens_names():
                raise LensError(
                    f"no bundled lens {shown(str(source))}; bundled: {', '.join(lens_names())}; "
                    "for a file of your own give a path that ends in .yaml or "
                    f"{', '.join(_READERS)}"
                )
            path = _BUNDLED / f"{source}.yaml"
        try:
            values, lines = read_yaml(path)
        except InputError as error:
            raise LensError(f"{path}: {error}") from error
        try:
            return build_lens(values, path.stem)
        except LensError as error:
            raise LensError(f"{path}{lines.of(error.key)}: {error}", error.key) from None


def load_system(path: str | pathlib.Path, missing: Missing = "error") -> System:
    """Read a lens with its fields, wavelengths and aperture from a Zemax `.zmx` or CODE V
    `.seq` file of at most 16 MB; see docs/lens_files.md.

    What is read otherwise than it stands there, solves as the values beside them say, is told in
    one warning and in `System.notes`. LensError, in one line with the line of the file, for what
    is not read.

    missing: "error" refuses what we have not; "warn" leaves it out where rays can go on without,
        and says so.
    """
    kind = pathlib.Path(path).suffix.lower()
    if kind not in _READERS:
        known = ", ".join(_READERS)
        raise LensError(f"{path}: fields and wavelengths are read from {known}; use load_lens")
    with jax.core.eval_context():
        record, use = _read(path, missing)
        system = system_of(record, use)
    record.say()
    return system


def _read(path: str | pathlib.Path, missing: Missing) -> tuple[Record, Use]:
    """A file of another program."""
    if missing not in ("error", "warn"):
        raise ValueError(f'missing: expected "error" or "warn", got {shown(missing)}')
    return _READERS[pathlib.Path(path).suffix.lower()](str(path), missing)
