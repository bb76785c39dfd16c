"""Load lenses: the bundled ones, YAML prescriptions, and files of Zemax and CODE V."""

import pathlib
from collections.abc import Mapping
from typing import Any

import jax

from ..inputs import parse, read_text, require_one_of, shown
from ..lens.lens import Lens
from .agf import load_agf
from .entry import LensError
from .record import Missing, Record, lines_of, naming
from .seq import read_seq
from .specs import build_lens
from .system import System, Use, lens_of, system_of
from .zmx import read_zmx

_BUNDLED = pathlib.Path(__file__).resolve().parents[1] / "lens" / "catalogue" / "lenses"
_READERS = {".zmx": read_zmx, ".seq": read_seq}
_ENDINGS = (".yaml", ".yml", *_READERS)


def lens_names() -> list[str]:
    """Names of the bundled prescriptions."""
    return sorted(path.stem for path in _BUNDLED.glob("*.yaml"))


def load_lens(source: str | pathlib.Path | Mapping, missing: Missing = "error") -> Lens:
    """Read a lens.

    The arrays have JAX's default floating dtype: float64 if the caller enabled it. LensError, with
    the line, for a missing file, an unknown key or glass, or numbers that make no lens.

    source: a bundled name (see `lens_names`), the path of a YAML prescription of at most 1 MB or
        of a Zemax `.zmx` or CODE V `.seq` file, see `load_system`, or a mapping with the keys of a
        prescription.
    missing: see `load_system`.
    """
    with jax.core.eval_context():  # a lens loaded inside a jitted function is a constant
        if isinstance(source, Mapping):
            return build_lens(_with_catalogues(dict(source), pathlib.Path()))
        path = pathlib.Path(source)
        if str(source) in lens_names():
            path = _BUNDLED / f"{source}.yaml"
        elif not path.suffix:
            raise LensError(
                f"no bundled lens {shown(str(source))}; bundled: {', '.join(lens_names())}; for a "
                f"file of your own give a path that ends in {', '.join(_ENDINGS)}"
            )
        if known_ending(path) in _READERS:
            record, use = read_record(path, missing)
            lens = lens_of(record, use)
            record.say()
            return lens
        with naming(path):
            return _lens_of_yaml(read_text(path), path)


def known_ending(path: str | pathlib.Path) -> str:
    """The ending of a path, in small letters. LensError for one of no kind of file here."""
    kind = pathlib.Path(path).suffix.lower()
    if kind not in _ENDINGS:
        raise LensError(f"{path}: expected a name that ends in {', '.join(_ENDINGS)}")
    return kind


def lens_in(text: str, path: str | pathlib.Path) -> tuple[Lens, dict[str, Any]]:
    """The lens of the text of a file, and of its use the fields of `System` that need no ray; none
    of a prescription. LensError as of `load_lens`. path: its name."""
    kind = known_ending(path)
    if kind not in _READERS:
        return _lens_of_yaml(text, pathlib.Path(path)), {}
    record, use = _READERS[kind](str(path), "error", text.splitlines())
    return lens_of(record, use), use.of_system() | {"distance": record.distance}


def _lens_of_yaml(text: str, path: pathlib.Path) -> Lens:
    """The lens of a prescription. InputError for what is no YAML."""
    values, lines = parse(text)
    try:
        return build_lens(_with_catalogues(values, path.parent), path.stem)
    except LensError as error:
        raise LensError(f"{path}{lines.of(error.key)}: {error}", error.key) from None


def _with_catalogues(top: Any, folder: pathlib.Path) -> Any:
    """Add to `glasses` of a prescription the glasses that it uses from its `catalogues`. They take
    precedence over the built-in table, and the prescription's own glasses over them."""
    if not isinstance(top, dict) or "catalogues" not in top:
        return top
    paths, surfaces = top["catalogues"], top.get("surfaces")
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise LensError(f"catalogues: expected a list of paths, got {shown(paths)}", "catalogues")
    places = [top.get("object"), *(surfaces if isinstance(surfaces, list) else [])]
    used = [place.get("glass") for place in places if isinstance(place, dict)]
    found: dict[str, dict[str, list[float]]] = {}
    for path in paths:
        try:
            read = load_agf(folder / path, [name for name in used if isinstance(name, str)])
        except LensError as error:
            raise LensError(f"catalogues: {error}", "catalogues") from None
        for name, glass in read.items():
            constants = {key: [*getattr(glass, key)] for key in ("sellmeier", "schott", "range")}
            found.setdefault(name, constants)
    own = top.get("glasses", {})
    rest = {key: value for key, value in top.items() if key != "catalogues"}
    return rest | {"glasses": found | own if isinstance(own, dict) else own}


def load_system(path: str | pathlib.Path, missing: Missing = "error") -> System:
    """Read a lens with its fields, wavelengths and aperture from a Zemax `.zmx` or CODE V
    `.seq` file of at most 16 MB; see docs/lens_files.md.

    One warning and `System.notes` list what is read differently from the file, such as solves,
    which are read as the values beside them. LensError, in one line with the line of the file, for
    a feature that is not read.

    missing: "error" refuses features that the package lacks; "warn" leaves them out, and lists
        them, if rays can be traced without them.
    """
    kind = pathlib.Path(path).suffix.lower()
    if kind not in _READERS:
        known = ", ".join(_READERS)
        raise LensError(f"{path}: fields and wavelengths are read from {known}; use load_lens")
    with jax.core.eval_context():
        record, use = read_record(path, missing)
        system = system_of(record, use)
    record.say()
    return system


def read_record(path: str | pathlib.Path, missing: Missing = "error") -> tuple[Record, Use]:
    """Read a file of another program."""
    require_one_of("missing", missing, ("error", "warn"))
    with naming(path):
        return _READERS[pathlib.Path(path).suffix.lower()](str(path), missing, lines_of(path))
