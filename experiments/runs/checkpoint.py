"""The state of a job in one file, with a checksum."""

import hashlib
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np


def packed(about: dict[str, Any], leaves: Sequence[np.ndarray]) -> bytes:
    """A file that holds arrays and, as JSON, what they are: an .npz with a checksum of both."""
    text, file = json.dumps(about), io.BytesIO()
    entries: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
    np.savez(file, about=np.array(text), checksum=np.array(_checksum(text, leaves)), **entries)
    return file.getvalue()


def unpacked(content: bytes) -> tuple[dict[str, Any], list[np.ndarray]]:
    """What `packed` was given. ValueError, with the reason, for other content and damaged one."""
    try:
        with np.load(io.BytesIO(content)) as saved:
            text, checksum = str(saved["about"]), str(saved["checksum"])
            leaves = [saved[f"leaf{i}"] for i in range(len(saved.files) - 2)]
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError("is no checkpoint, or a damaged one") from error
    if _checksum(text, leaves) != checksum:
        raise ValueError("is damaged: its checksum is another")
    return json.loads(text), leaves


def finite(leaves: Sequence[np.ndarray]) -> bool:
    """True if all numbers of arrays are finite."""
    numbers = (leaf for leaf in leaves if np.issubdtype(leaf.dtype, np.inexact))
    return all(bool(np.all(np.isfinite(leaf))) for leaf in numbers)


def _checksum(about: str, leaves: Sequence[np.ndarray]) -> str:
    sums = hashlib.sha256(about.encode())
    for leaf in leaves:
        sums.update(f"{leaf.dtype.str}{leaf.shape}".encode())
        sums.update(leaf.tobytes())
    return sums.hexdigest()
