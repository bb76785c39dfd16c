"""One self-contained HTML page of tables, text and figures, for any screen."""

import base64
import html
import io
import pathlib
from collections.abc import Sequence

import matplotlib
from matplotlib.figure import Figure

# Rows of a table, the header first; text; a figure; or the file of a PNG picture.
Part = Sequence[Sequence[str]] | str | Figure | pathlib.Path
# Vector graphics above this size, in characters, are drawn as pixels instead.
_LARGEST = 150_000
# Widest figure, inches, that stands in one of two columns.
_COLUMN = 6.5
# Most characters of a row of a table there.
_LONGEST = 80
_STYLE = """
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif }
body { max-width: 90rem; margin: 0 auto; padding: 1rem }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 1rem }
main { display: grid; gap: 0 2rem; grid-template-columns: minmax(0, 1fr) }
@media (min-width: 60rem) {
  main { grid-template-columns: repeat(2, minmax(0, 1fr)) } .both { grid-column: 1 / -1 }
}
figure { margin: 0; background: white; overflow-x: auto; color: black }
figure :is(img, svg) { width: 100%; height: auto }
.wide { overflow-x: auto } pre { overflow-x: auto; font-size: .85rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
th, td { padding: .2rem .7rem; text-align: left } th { vertical-align: bottom }
tr { border-bottom: 1px solid #8885 }
@media (max-width: 40rem) {
  body { padding: .4rem } th, td { padding: .2rem .25rem; font-size: .75rem; hyphens: auto }
}
"""


def page(title: str, parts: Sequence[tuple[str, Part]]) -> str:
    """A page of HTML that needs no other file.

    parts: headings, each with rows of a table, text, a Markdown table, a figure or a PNG file. On a
        wide window, figures of at most 6.5 inches, and tables of short rows, stand in two columns.
    """
    body = [f"<h1>{html.escape(title)}</h1><main>"]
    for heading, part in parts:
        kind = "" if _narrow(part) else ' class="both"'
        body.append(f"<section{kind}><h2>{html.escape(heading)}</h2>{_shown(part)}</section>")
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    head += f"<title>{html.escape(title)}</title><style>{_STYLE}</style>"
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n'
        + "\n".join(body)
        + "\n</main></body></html>\n"
    )


def _narrow(part: Part) -> bool:
    """Whether a part fits into one of two columns."""
    if isinstance(part, Figure):
        return part.get_figwidth() <= _COLUMN
    if isinstance(part, str | pathlib.Path):
        return False
    return max(sum(map(len, map(str, row))) for row in part) <= _LONGEST


def _shown(part: Part) -> str:
    if isinstance(part, Figure):
        return f"<figure>{_drawn(part)}</figure>"
    if isinstance(part, pathlib.Path):
        return f"<figure>{_picture(part.read_bytes())}</figure>"
    if not isinstance(part, str):
        return _table(part)
    lines = part.strip().splitlines()
    if all(line.startswith("|") for line in lines):
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        return _table([cells[0], *cells[2:]])
    return f"<pre>{html.escape(part)}</pre>"


def _table(rows: Sequence[Sequence[str]]) -> str:
    tags = ["th", *["td"] * (len(rows) - 1)]
    lines = (
        "<tr>" + "".join(f"<{tag}>{html.escape(str(cell))}</{tag}>" for cell in row) + "</tr>"
        for tag, row in zip(tags, rows)
    )
    return '<div class="wide"><table>' + "\n".join(lines) + "</table></div>"


def _drawn(figure: Figure) -> str:
    """A figure as vector graphics, or as pixels if these are smaller."""
    written = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):  # text as text, a third of the size
        figure.savefig(written, format="svg", metadata={"Date": None})
    text = written.getvalue()
    if len(text) <= _LARGEST:
        return text[text.index("<svg") :]
    pixels = io.BytesIO()
    figure.savefig(pixels, format="png")
    return _picture(pixels.getvalue())


def _picture(content: bytes) -> str:
    return f'<img alt="" src="data:image/png;base64,{base64.b64encode(content).decode()}">'
