"""Lenses in YAML: the bundled ones and files of your own."""

import pathlib
from collections.abc import Mapping

import jax
import yaml

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
    for a missing file, an unknown key or glass, or numbers that make no lens.

    source: a bundled name (see `lens_names`), the path of a YAML prescription, or a mapping with
        the keys of one.
    """
    with jax.core.eval_context():  # a lens loaded inside a jitted function is a constant
        if isinstance(source, Mapping):
            return build_lens(dict(source))
        path = pathlib.Path(source)
        if path.suffix not in (".yaml", ".yml"):
            path = _BUNDLED / f"{source}.yaml"
            if not path.is_file():
                raise LensError(
                    f"no bundled lens {str(source)!r}; bundled: {', '.join(lens_names())}; "
                    "for a file of your own give a path that ends in .yaml"
                )
        try:
            return build_lens(yaml.safe_load(path.read_text()), path.stem)
        except OSError as error:
            raise LensError(f"{path}: cannot be read: {error.strerror}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise LensError(f"{path}: not a YAML file: {error}") from error
        except LensError as error:
            raise LensError(f"{path}: {error}") from None
