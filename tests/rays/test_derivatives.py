"""Every derivative compared with an independent trace: `drt_jax` in reverse and in forward mode
with the complex step through `oracle`, whose derivatives are checked by 50-digit differences."""

import dataclasses
import functools
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, Status, load_lens, pupil
from drt_jax.image.moments import weigh
from drt_jax.lens.scene import checked_scene
from drt_jax.pupil.rules import Gauss
from drt_jax.rays.fermat import arrival, optical_path
from drt_jax.rays.find import Found
from drt_jax.rays.solve import reattach
from drt_jax.rays.trace import aims, bundle_of

from .. import oracle
from ..known import bendable

WAVELENGTHS = (0.6, 0.48)
ORDER = 3
POINTS = np.array([[0.3, 0.9], [-0.5, 0.2], [0.1, -0.6]])
OUTPUTS = ("centroid", "covariance", "path")
TABLE = pathlib.Path(__file__).parents[2] / "results" / "derivatives" / "derivatives.md"
LARGEST = 1e-8

# All forms, everything tilted and decentred, a refracting stop.
FREEFORM = [
    {
        "radius": 60,
        "conic": -0.3,
        "coefficients": {4: 1e-6, 6: -2e-9},
        "thickness": 6,
        "glass": "N-BK7",
        "tilt": [0.6, -0.8, 0.3],
        "decentre": [0.1, -0.2],
    },
    {
        "form": "odd_asphere",
        "radius": -150,
        "conic": 0.5,
        "thickness": 3,
        "coefficients": {1: 5e-4, 3: 1e-5, 4: -3e-7},
        "tilt": [-0.4, 0.5, 0.0],
        "decentre": [-0.2, 0.3],
    },
    {
        "form": "polynomial_xy",
        "radius": 80,
        "conic": -0.7,
        "thickness": 6,
        "glass": "F2",
        "coefficients": {
            "x1y0": 1e-3,
            "x0y1": -2e-3,
            "x2y0": 1e-4,
            "x1y1": 2e-4,
            "x0y2": -1e-4,
            "x2y1": 3e-6,
        },
        "tilt": [0.3, 0.2, -0.7],
        "decentre": [0.3, 0.1],
    },
    {
        "form": "biconic",
        "radius": -90,
        "conic": 0.4,
        "radius_x": -120,
        "conic_x": -0.5,
        "coefficients": {4: 1e-6},
        "thickness": 5,
        "semi_diameter": 5,
        "stop": True,
        "tilt": [0.7, 0.4, 1.0],
        "decentre": [-0.1, 0.25],
    },
    {
        "form": "toroid",
        "radius": 75,
        "conic": -0.2,
        "radius_x": 85,
        "coefficients": {4: 2e-6},
        "thickness": 5,
        "index": 1.6,
        "tilt": [-0.5, 0.6, 2.0],
        "decentre": [0.15, -0.1],
    },
    {
        "radius": -110,
        "conic": 0.1,
        "coefficients": {4: -1e-6},
        "tilt": [0.2, 0.9, -0.4],
        "decentre": [-0.3, 0.2],
    },
]
# Two mirrors side by side, tilted by 30 degrees; the second is curved. The stop is behind them.
FOLDED = [
    {"radius": 120, "conic": -0.5, "thickness": 6, "glass": "N-BK7"},
    {"radius": -300, "thickness": 24},
    {"radius": "inf", "thickness": -10, "mirror": True, "tilt": [30, 0, 0]},
    {
        "form": "biconic",
        "radius": -900,
        "conic": 0.3,
        "radius_x": -700,
        "conic_x": -0.4,
        "thickness": 12,
        "mirror": True,
        "tilt": [30, 0.5, 0],
        "decentre": [0.1, 17.3205],
    },
    {"radius": "inf", "thickness": 8, "semi_diameter": 6, "stop": True, "decentre": [0, 17.3205]},
    {
        "radius": 70,
        "conic": 0.2,
        "thickness": 5,
        "glass": "SF10",
        "decentre": [0.3, 17.4],
        "tilt": [0.3, -0.2, 0.1],
    },
    {"radius": 150, "coefficients": {4: 1e-6}, "decentre": [-0.2, 17.3]},
]
# Rotationally symmetric, with a surface inside a glass, which bends no light.
ROUND = [
    {
        "radius": 45,
        "conic": -0.6,
        "coefficients": {4: 1e-6, 6: -1e-9},
        "thickness": 4,
        "glass": "N-BK7",
    },
    {"radius": 200, "thickness": 3, "glass": "N-BK7"},
    {
        "form": "odd_asphere",
        "radius": -180,
        "conic": 0.4,
        "thickness": 4,
        "coefficients": {2: 1e-4, 3: 1e-5, 4: -2e-7},
    },
    {"radius": "inf", "thickness": 4, "semi_diameter": 7, "stop": True},
    {"radius": -60, "conic": 0.3, "coefficients": {4: -1e-6}, "thickness": 3, "glass": "SF10"},
    {"radius": 140, "conic": 0.2},
]


# Lens, field in radians, distances in mm, part of the pupil for the moments.
SCENES = {
    "freeform": (
        {
            "surfaces": FREEFORM,
            "sensor": 110,
            "sensor_tilt": [1.5, -2.0, 3.0],
            "sensor_decentre": [0.4, -0.3],
        },
        [0.06, -0.09],
        (300.0,),
        "none",
    ),
    "folded": (
        {
            "surfaces": FOLDED,
            "sensor": 100,
            "sensor_tilt": [0.5, 0.3, 0.0],
            "sensor_decentre": [0.0, 17.0],
        },
        [0.02, 0.03],
        (500.0,),
        "none",
    ),
    "double_gauss": ("double_gauss", np.radians(10), (25000.0, np.inf), "bilateral"),
    "on_axis": ({"surfaces": ROUND, "sensor": 110}, 0.0, (400.0,), "rotational"),
}
TITLES = {
    "freeform": "No symmetry, all forms, tilts and decentres; field (0.06, -0.09), 300 mm",
    "folded": "Two mirrors; field (0.02, 0.03), 500 mm",
    "double_gauss": "Double Gauss, half the pupil; 10 degrees, {} mm",
    "on_axis": "Rotational aspheres on axis, meridional rays; 400 mm",
}
HEADER = f"""# Derivatives of the centroid, the covariance and the optical path

Largest relative errors of our derivatives, in reverse / forward mode, in float64. The reference
is the complex step (h = 1e-30) through an independent Snell trace (`tests/oracle.py`), which is
itself proved against 50-digit central differences. Written by

    python -m pytest tests/rays/test_derivatives.py -m "" --write-tables

Colours {WAVELENGTHS[0]} and {WAVELENGTHS[1]} um; moments of `Gauss({ORDER}, symmetry)`, paths of
{len(POINTS)} rays. Each number is the largest, over the elements of the output and of the array of
the parameter, of |ours - reference| / max(|reference|, 1e-4 x the largest |reference| of that
array for that element of the output). 0: both are exactly 0, or equal. Both modes agree within
1e-10 of the largest element. `schott`, `strength` and `resonance` are the constants of the
refractive indices; semi_diameter is that of the stop. No entry may exceed {LARGEST:g} (tilts
and decentres include the sensor's).
"""


def load(name):
    """The lens of a scene, every row of which may be curved; the freeform has a curved sensor."""
    lens = bendable(load_lens(SCENES[name][0]))
    if name != "freeform":
        return lens
    curvature, conic = lens.curvature.at[-1].set(-1 / 150), lens.conic.at[-1].set(0.4)
    return dataclasses.replace(lens, curvature=curvature, conic=conic)


def parameters(name, distance):
    """The differentiated arguments, and the names of the rows."""
    _, field, _, symmetry = SCENES[name]
    lens = load(name)
    arguments = {"lens": lens, "distance": jnp.asarray(distance)}
    if symmetry != "rotational":
        arguments["field"] = jnp.asarray(field, float)
    rows = [*oracle.LENS, *oracle.MEDIA]
    rows += oracle.MOVES if lens.tilt is not None else ()
    rows += ("field",) if "field" in arguments else ()
    rows += ("distance",) if np.isfinite(distance) else ()
    return arguments, [row for row in rows if row != "coefficients" or lens.coefficients.size]


@functools.partial(jax.jit, static_argnums=1)
def derivatives(arguments, rule, hits):
    """The derivatives of all outputs in reverse and in forward mode. hits: result of `hits_of`."""

    def outputs(arguments):
        lens, scene = arguments["lens"], scene_from(arguments)
        nodes, weights = rule.points(lens, scene)
        bundles = bundles_of(nodes)
        rays = [found(aims(lens, scene, points), known) for points, known in zip(bundles, hits)]
        weights = jnp.pad(weights, ((0, 0), (0, len(bundles[0][0]) - weights.shape[1])))
        spot = weigh(lens, rule, weights, bundle_of(lens, scene, *rays[0])).at(lens.sensor)
        system, _, last = rays[-1]
        last = tuple(hit[..., -len(POINTS) :] for hit in last.hits)
        return spot.mean, spot.covariance, optical_path(last, system)

    tangents = jax.linearize(outputs, arguments)[1]  # linear, for both modes
    return jax.jacrev(tangents)(arguments), jax.jacfwd(tangents)(arguments)


def found(aims, hits):
    """Aims, and the rays with derivatives."""
    system, target = aims
    ok = jnp.full(hits[0].shape[1:], Status.OK, jnp.int32)
    rays = Found(hits, arrival(hits, system), ok, jnp.int32(0))
    return system, target, reattach(rays, system, target)


def bundles_of(nodes):
    """The points of a rule and `POINTS`, as one bundle unless the rule has meridional rays."""
    points = tuple(POINTS.T)
    return [nodes, points] if len(nodes) == 1 else [tuple(map(jnp.append, nodes, points))]


def hits_of(lens, scene, nodes):
    """Hits by the oracle on the active surfaces, for the rays of `bundles_of`."""
    for points in bundles_of(nodes):
        plane = np.stack([*[np.zeros_like(points[0])] * (2 - len(points)), *points])
        own = oracle.trace(scene, *oracle.aim(scene, plane)).own
        rows = np.real([own[row][:2] for row in (*lens.active, -1)])
        yield tuple(np.moveaxis(rows, 1, 0))[-len(points) :]


def scene_from(arguments):
    field = arguments.get("field", 0.0)
    return checked_scene(arguments["lens"], Scene.point(field, arguments["distance"], WAVELENGTHS))


def of_row(tree, row):
    """The derivative by one parameter."""
    if row in oracle.SCENE:
        return np.asarray(tree[row])
    lens = tree["lens"]
    return np.asarray(getattr(lens.dispersion if row in oracle.MEDIA else lens, row))


def relative_error(ours, reference, rank, floor=1e-4):
    """Error as defined in the header of the table; `rank` is that of the parameter's array."""
    if reference.size == 0:
        return 0.0
    assert ours.shape == reference.shape and np.all(np.isfinite(ours))
    axes = tuple(range(reference.ndim - rank, reference.ndim))
    size = np.abs(reference)
    scale = np.maximum(size, floor * np.max(size, axis=axes, keepdims=True))
    error = np.abs(ours - reference)
    return float(np.max(np.where(error == 0, 0, error / np.where(scale == 0, 1e-300, scale))))


def write_section(title, rows):
    """Writes the table of one scene into the file."""
    text = TABLE.read_text() if TABLE.is_file() else ""
    sections = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", text, flags=re.M | re.S))
    lines = [f"| parameter | {' | '.join(OUTPUTS)} |", "|--" * (1 + len(OUTPUTS)) + "|"]
    for row, cells in rows.items():
        cells = (" / ".join(f"{error:.1e}" if error else "0" for error in cell) for cell in cells)
        lines.append(f"| {row} | {' | '.join(cells)} |")
    sections[title] = "\n" + "\n".join(lines) + "\n"
    ordered = [t for t in titles() if t in sections]
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    TABLE.write_text(HEADER + "".join(f"\n## {t}\n\n{sections[t].strip()}\n" for t in ordered))


def title_of(name, distance):
    return TITLES[name].format("inf" if np.isinf(distance) else f"{distance:g}")


def titles():
    return [title_of(name, distance) for name in SCENES for distance in SCENES[name][2]]


@pytest.mark.parametrize(
    "name", [n if n == "double_gauss" else pytest.param(n, marks=pytest.mark.slow) for n in SCENES]
)
def test_all_derivatives_agree_with_the_complex_step(name, write_tables):
    _, field, distances, symmetry = SCENES[name]
    rule = (
        pupil.meridian(ORDER)
        if symmetry == "rotational"
        else (pupil.half_disc if symmetry == "bilateral" else pupil.disc)(ORDER, ORDER + 1)
    )
    nodes, weights = rule[0].T, rule[1]
    if len(nodes) == 1:
        nodes = np.concatenate([np.zeros_like(nodes), nodes])
    gauss = Gauss(ORDER, symmetry)
    for distance in distances:
        arguments, rows = parameters(name, distance)
        lens = arguments["lens"]
        scene = oracle.Scene.of(lens, field, distance, WAVELENGTHS)
        hits = tuple(hits_of(lens, scene, gauss.points(lens, None)[0]))
        ours = derivatives(arguments, gauss, hits)
        wanted = oracle.jacobian(scene, (nodes, weights), symmetry, POINTS.T, rows)
        table = {}
        for row in rows:
            table[row] = []
            for i, output in enumerate(OUTPUTS):
                reference, rank = wanted[output][row], scene.values[row].ndim
                if row == "field" and np.ndim(field) == 0:  # one angle, along y
                    reference, rank = reference[..., 1], 0
                both = [of_row(tree[i], row) for tree in ours]
                table[row].append([relative_error(each, reference, rank) for each in both])
                # Relative to the largest element; those that are 0 by geometry are only rounding.
                assert relative_error(*both, rank, floor=1) <= 1e-10, (row, output)
        if write_tables:
            write_section(title_of(name, distance), table)
        worst = {row: max(map(max, cells)) for row, cells in table.items()}
        assert max(worst.values()) <= LARGEST, worst
        if np.isinf(distance):
            assert all(np.all(of_row(tree[i], "distance") == 0) for tree in ours for i in range(3))


def test_the_committed_table_is_complete():
    text = TABLE.read_text()
    for name in SCENES:
        for distance in SCENES[name][2]:
            section = text.split(f"## {title_of(name, distance)}\n")[1].split("\n## ")[0]
            cells = [line.strip("| ").split(" | ") for line in section.splitlines() if "|" in line]
            assert cells[0] == ["parameter", *OUTPUTS]
            assert [row[0] for row in cells[2:]] == parameters(name, distance)[1]
            numbers = [float(n) for row in cells[2:] for cell in row[1:] for n in cell.split("/")]
            assert len(numbers) == 2 * len(OUTPUTS) * len(cells[2:])
            assert max(numbers) <= LARGEST
