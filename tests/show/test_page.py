"""HTML pages: their content, and their look in a browser."""

import pathlib
import re
import shutil
import subprocess

import numpy as np
import pytest
from PIL import Image

from drt_jax import load_lens, show
from drt_jax.__main__ import main

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
WIDTHS = (1920, 1280, 500)
KEPT = pathlib.Path(__file__).parents[2] / "results" / "pages"


def test_a_page_holds_tables_text_figures_and_pictures_and_needs_no_other_file(tmp_path):
    figure, axes = show.new()
    axes.plot([0, 1], [1, 0])
    figure.savefig(tmp_path / "line.png")
    text = show.page(
        "A < B",
        [
            ("Rows", [("name", "value"), ("n & k", "1.5")]),
            ("Markdown", "| a | b |\n|---|---|\n| 1 | 2 |"),
            ("Words", "if x < 3:\n  stop"),
            ("Figure", figure),
            ("Picture", tmp_path / "line.png"),
        ],
    )
    assert "<h1>A &lt; B</h1>" in text and "<td>n &amp; k</td><td>1.5</td>" in text
    assert "<th>a</th><th>b</th>" in text and "<td>1</td><td>2</td>" in text and "---" not in text
    assert "<pre>if x &lt; 3:\n  stop</pre>" in text and text.count("<svg") == 1
    assert 'src="data:image/png;base64,' in text
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    # The first table and the figure are narrow enough for one of two columns.
    assert text.count('<section class="both">') == 3 and text.count("<section>") == 2


def test_a_figure_of_many_points_is_drawn_as_pixels():
    figure, axes = show.new()
    axes.plot(*np.random.default_rng(0).random((2, 20_000)), ".")
    text = show.page("Many", [("Points", figure)])
    assert "<svg" not in text and len(text) < 600_000


def test_the_prescription_is_that_of_the_lens():
    tables = show.prescription(load_lens("cooke_triplet"), [9.0] * 6)
    header, *rows = tables["Surfaces"]
    assert [*tables] == ["Surfaces"] and len(rows) == 6
    assert all(len(row) == len(header) for row in rows)
    assert rows[0][:3] == ("0", "22.01359", "3.25896") and rows[3][0] == "3, stop"
    assert [row[3] for row in rows] == ["SK16", "air", "F2", "air", "SK16", "air"]
    assert header[6].startswith("used") and rows[0][5:] == ("9.5", "9")
    surfaces = show.prescription(load_lens("hubble"))["Surfaces"]
    assert next(row for row in surfaces if row[3] == "mirror")


# A model glass, an asphere and a surface out of place.
TYPED = {
    "surfaces": [
        {"radius": 50.0, "nd": 1.62040204782857, "vd": 60.3242871706773, "thickness": 9.0,
         "semi_diameter": 3, "stop": True, "conic": -0.75,
         "coefficients": {4: 1.25e-6, 8: -3.5e-12},
         "obscuration": {"circle": 0.5, "centre": [0, 0.1]}},
        {"radius": -70.0, "tilt": [1.5, 0, 0], "decentre": [0, 0.25]},
    ],
    "sensor": 80.0,
}  # fmt: skip


def test_a_lens_can_be_typed_in_again():
    """The tables have every number of the file: glass to five digits, coefficients by power, tilts
    in degrees."""
    lens = load_lens(TYPED)
    tables = show.prescription(lens)
    row = tables["Surfaces"][1]
    assert row == ("0, stop", "50", "9", "nd 1.62040, vd 60.324", "-0.75", "3")
    assert tables["Surfaces"][2][5] == "none"
    (title,) = (name for name in tables if name.startswith("Coefficients"))
    assert tables[title][1:] == [("0", "asphere", "4: 1.25e-06; 8: -3.5e-12")]
    assert tables["Decentres and tilts"][1:] == [("1", "0, 0.25", "1.5, 0, 0")]
    assert tables["Apertures and obscurations"][1:] == [
        ("0", "circle, obscuration", "0.5, 0.5", "0, 0.1")
    ]
    grating = {"radius": "inf", "phase": {"form": "linear", "coefficients": {"y": 300.0}}}
    plain = {"radius": "inf", "glass": "N-BK7", "thickness": 2, "semi_diameter": 3, "stop": True}
    tables = show.prescription(load_lens({"surfaces": [plain, grating], "sensor": 50}))
    (title,) = (name for name in tables if name.startswith("Diffractive"))
    assert tables[title][1:] == [("1", "linear", "1", "y: 300")]


@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason="no browser: apt-get install chromium")
def test_a_browser_shows_the_sheet_at_three_widths(tmp_path, capsys, write_tables):
    """Every analysis is drawn, and nothing extends beyond the screen or its own frame. With
    --write-tables the figures are written to results/pages."""
    page = tmp_path / "lens.html"
    words = ["show", "cooke_triplet", "--html", "--field", "0", "14", "20", "--out", str(page)]
    main(words)
    assert f"drawn in {page}, " in capsys.readouterr().out
    text = page.read_text()
    for title in ("First-order data", "Surfaces", "Layout", "Spots", "Lateral colour"):
        assert f"<h2>{title}</h2>" in text
    assert len(text) < 900_000  # small enough to mail
    told = """<script>
    const data = document.body.dataset, all = [...document.querySelectorAll(".wide, figure, pre")];
    data.wide = document.documentElement.scrollWidth;
    data.cut = all.filter(e => e.scrollWidth > e.clientWidth).length;
    </script>"""
    measured = tmp_path / "measured.html"
    measured.write_text(text.replace("</body>", told + "</body>"))
    for width in WIDTHS:
        size, shot = f"--window-size={width},3000", tmp_path / f"{width}.png"
        dom = browse(size, "--dump-dom", measured.as_uri())
        assert int(re.search(r'data-wide="(\d+)"', dom)[1]) <= width
        assert int(re.search(r'data-cut="(\d+)"', dom)[1]) == 0
        browse(size, f"--screenshot={shot}", page.as_uri())
        seen = np.asarray(Image.open(shot).convert("L"))
        assert seen.shape[1] == width
        assert np.mean(seen < 128) > 0.005  # text and curves
        drawn = np.any(seen < 250, axis=1)
        assert np.mean(drawn[:2000]) > 0.5
        if write_tables:
            KEPT.mkdir(exist_ok=True)
            Image.open(shot).convert("P", palette=Image.Palette.ADAPTIVE).save(
                KEPT / f"cooke_triplet_{width}.png", optimize=True
            )


def browse(*words: str) -> str:
    flags = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars")
    ran = subprocess.run(
        [BROWSER, *flags, *words], capture_output=True, text=True, timeout=120, check=True
    )
    return ran.stdout
