"""Write the tables of README.md and docs/ from results/: `python -m experiments.tables`.

The table NAME of an experiment replaces the block between `<!-- table: NAME -->` and
`<!-- end -->`.
"""

import argparse
import pathlib
import re

import experiments

from . import _common

_PREFIXES = "paper", "gpu", "scenes"  # folders of results
_BLOCK = re.compile(r"(<!-- table: (.+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def pages() -> list[pathlib.Path]:
    """The files that hold tables."""
    return [_common.ROOT / "README.md", *sorted((_common.ROOT / "docs").glob("*.md"))]


def all_tables() -> dict[str, str]:
    """Tables of all experiments by name, from the committed results."""
    found = {}
    for path in sorted((_common.ROOT / "results").rglob("results.json")):
        experiment = _common.experiment(path.parent.name, path.parents[1].name)
        tables = experiment.tables(_common.read_results(path.parent))
        # Those of configs/paper/ have the names of the shorter runs, those of a GPU of a CPU's, and
        # those of more scenes of the benchmark's.
        of = path.parents[1].name
        prefix = f"{of}: " if of in _PREFIXES else ""
        found |= {prefix + name: table for name, table in tables.items()}
    return found


def filled(text: str, tables: dict[str, str]) -> str:
    """A page with its blocks replaced. Blocks for GPU results without results stay as they are;
    ConfigError for another unknown table."""

    def block(found: re.Match) -> str:
        name = found[2]
        if name.startswith("gpu: ") and name not in tables:
            return found[0]
        _common.require_known("tables", (name,), tables)
        return f"{found[1]}{tables[name]}\n{found[3]}"

    return _BLOCK.sub(block, text)


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    argparse.ArgumentParser(description=__doc__).parse_args(argv)
    experiments.left = lambda: "pages are whole"
    tables = all_tables()
    for page in pages():
        text = filled(page.read_text(), tables)
        if text != page.read_text():
            page.write_text(text)
            print(f"written: {page}")


if __name__ == "__main__":
    main()
