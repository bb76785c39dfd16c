"""Lenses in YAML: the bundled ones and files of your own."""

import pathlib
from collections.abc import Mapping

import jax

from ..inputs import InputError, read_yaml, shown
from ..lens.lens import Lens
from .entry import LensError
from .specs import build_lens

_BUNDLED = pathlib.Path(__file__).resolve().parents[1] / "lens" / "catalogue" / "lenses"


def lens_names() -> list[str]:
    """Names of the bundled prescriptions."""
    return sorted(path.stem for path in _BUNDLED.glob("*.yaml"))


def load_lens(source: str | pathlib.Path | Mapping) -> Lens:
    """Read a lens.

    The arrays have JAX's default floating dtype: float64 where the caller enabled it. LensError
    for a missing file, an unknown key or glass, or numbers that make no lens, with the line.

    source: a bundled name (see `lens_names`), the path of a YAML prescription of at most 1 MB, or a
        mapping with the keys of one.
    """
    with jax.core.eval_context():  # a lens loaded inside a jitted function is a constant
        if isinstance(source, Mapping):
            return build_lens(dict(source))
        path = pathlib.Path(source)
        if path.suffix.lower() not in (".yaml", ".yml"):
            if str(source) not in lens_names():
                raise LensError(
                    f"no bundled lens {shown(str(source))}; bundled: {', '.join(lens_names())}; "
                    "for a file of your own give a path that ends in .yaml"
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
