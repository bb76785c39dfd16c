"""The state of a job in one file, with a checksum."""

import dataclasses
import hashlib
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from drt_jax.inputs import shown


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The state of a job after some steps.

    job: name of the job.
    step: number of steps.
    seconds: time spent on the run.
    settings: digest of the settings of the run.
    leaves: arrays of the state.
    """

    job: str
    step: int
    seconds: float
    settings: str
    leaves: list[np.ndarray]

    def packed(self) -> bytes:
        """The file: an .npz of the leaves, the rest as JSON, and a checksum of both."""
        about = json.dumps({name: vars(self)[name] for name in _ABOUT})
        entries: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(self.leaves)}
        checksum = _checksum(about, self.leaves)
        file = io.BytesIO()
        np.savez(file, about=np.array(about), checksum=np.array(checksum), **entries)
        return file.getvalue()

    def check(self, job: str, settings: str, most: float, forms: list | None) -> None:
        """ValueError with the reason, unless the checkpoint belongs to the job and the settings and
        its leaves are finite.

        most: largest step.
        forms: shape and dtype of each leaf; None for any.
        """
        if self.job != job:
            raise ValueError(f"belongs to the job {shown(self.job)}")
        if self.settings != settings:
            raise ValueError("belongs to other settings than those in config.yaml")
        if not 0 <= self.step <= most:
            raise ValueError(f"is of step {self.step}, not of one from 0 to {most}")
        if forms is not None and [(leaf.shape, leaf.dtype) for leaf in self.leaves] != forms:
            raise ValueError("holds arrays of other shapes or dtypes")
        if not self.finite():
            raise ValueError("holds numbers that are not finite")

    def finite(self) -> bool:
        """True if all numbers of the leaves are finite."""
        numbers = (leaf for leaf in self.leaves if np.issubdtype(leaf.dtype, np.inexact))
        return all(bool(np.all(np.isfinite(leaf))) for leaf in numbers)


_ABOUT = ("job", "step", "seconds", "settings")


def unpacked(content: bytes) -> Checkpoint:
    """Reads a checkpoint from the content of a file. ValueError, with the reason, if it is none or
    damaged."""
    try:
        with np.load(io.BytesIO(content)) as saved:
            about, checksum = str(saved["about"]), str(saved["checksum"])
            leaves = [saved[f"leaf{i}"] for i in range(len(saved.files) - 2)]
        found = Checkpoint(**json.loads(about), leaves=leaves)
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError("is no checkpoint, or a damaged one") from error
    if _checksum(about, leaves) != checksum:
        raise ValueError("is damaged: its checksum is another")
    return found


def _checksum(about: str, leaves: Sequence[np.ndarray]) -> str:
    sums = hashlib.sha256(about.encode())
    for leaf in leaves:
        sums.update(f"{leaf.dtype.str}{leaf.shape}".encode())
        sums.update(leaf.tobytes())
    return sums.hexdigest()
