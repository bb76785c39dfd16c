"""metrics.csv: a row with a checksum for each step of each job."""

import csv
import io
import os
import pathlib
import zlib

import numpy as np

from .config import ConfigError
from .disk import replace


class Metrics:
    """The file metrics.csv. It always has a header; all rows of a call are appended or none.

    columns: columns between `job`, `step` and the last one, `check`.
    """

    def __init__(self, path: pathlib.Path, columns: tuple[str, ...]):
        self.path = path
        self.columns = ("job", "step", *columns)
        self._header = (",".join((*self.columns, "check")) + "\r\n").encode()

    def write(self, rows: list[list[str]]) -> None:
        """Replaces the file by one with these rows."""
        replace(self.path, self._header + _text(rows))

    def mend(self) -> None:
        """Repairs the file after the process was killed: writes a missing or partial header, and
        drops an incomplete last line. ConfigError for other damage."""
        content = self.path.read_bytes() if self.path.exists() else b""
        if self._header.startswith(content):
            self.write([])
        elif (whole := content[: content.rfind(b"\n") + 1]) and len(whole) < len(content):
            replace(self.path, whole)
        self._rows()

    def append(self, job: str, step: int, rows: dict[str, np.ndarray]) -> None:
        """Appends rows of consecutive steps.

        job: job of the rows.
        step: first step.
        rows: (N,) values of N steps by column; other columns stay empty, unknown ones are ignored.
        """
        lines = []
        for i, values in enumerate(zip(*rows.values())):
            known = {name: float(value) for name, value in zip(rows, values)}
            lines.append([job, step + i, *(known.get(name, "") for name in self.columns[2:])])
        content = _text(lines)
        with open(self.path, "r+b", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            try:
                while content:  # a disk that is nearly full may accept only a part
                    content = content[file.write(content) :]
            except OSError:
                file.truncate(end)
                raise

    def of(self, job: str) -> dict[str, np.ndarray]:
        """The rows of one job as arrays by column, with `step`; NaN where empty."""
        rows = [row for row in self._rows() if row[0] == job]
        found = ([float(row[k] or "nan") for row in rows] for k in range(1, len(self.columns)))
        return dict(zip(self.columns[1:], map(np.array, found)))

    def cut(self, jobs: tuple[str, ...], step: int, remedy: str) -> None:
        """Drops the rows of jobs from a step on. ConfigError, with the remedy, unless each job has
        the rows of all steps before it."""
        rows = self._rows()
        kept = [row for row in rows if row[0] not in jobs or int(row[1]) < step]
        for job in jobs:
            if [int(row[1]) for row in kept if row[0] == job] != list(range(step)):
                wrong = f"not one row of {job} for each of the {step} steps before its checkpoint"
                raise ConfigError(f"{self.path}: {wrong}; put them back, or {remedy}")
        if len(kept) < len(rows):
            self.write(kept)

    def order(self) -> None:
        """Sorts the rows by job and step, so that the file does not depend on interruptions."""
        rows = self._rows()
        place = {job: k for k, job in enumerate(dict.fromkeys(row[0] for row in rows))}
        self.write(sorted(rows, key=lambda row: (place[row[0]], int(row[1]))))

    def sync(self) -> None:
        """Flushes the rows to the disk."""
        with open(self.path, "rb+") as file:
            os.fsync(file.fileno())

    def _rows(self) -> list[list[str]]:
        """All rows as text. ConfigError, with the line, for a damaged one."""
        text = self.path.read_bytes().decode(errors="replace")
        reader = csv.reader(io.StringIO(text, newline=""))
        header, rows = [*self.columns, "check"], []
        try:
            if next(reader, None) != header:
                raise ValueError(f"expected the header {','.join(header)}")
            for *row, check in reader:
                if len(row) != len(self.columns):
                    raise ValueError(f"expected {len(header)} values, got {len(row) + 1}")
                _ = int(row[1]), [float(word) for word in row[2:] if word]
                if check != _check(row):
                    raise ValueError("its checksum is another")
                rows.append(row)
        except (csv.Error, ValueError) as error:
            where = f"{self.path}, line {max(reader.line_num, 1)}"
            remedy = "mend it, or delete the file and the folder checkpoints to begin anew"
            raise ConfigError(f"{where}: {str(error)[:90]}; {remedy}") from error
        return rows


def _text(rows: list[list]) -> bytes:
    """Rows as text, each with its checksum."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows([*row, _check(row)] for row in rows)
    return text.getvalue().encode()


def _check(row: list) -> str:
    """Checksum of a row."""
    return f"{zlib.crc32(','.join(map(str, row)).encode()):08x}"
