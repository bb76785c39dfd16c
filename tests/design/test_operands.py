"""Values of operands, computed in other ways; and errors for lenses to which they do not apply."""

import dataclasses
import pathlib
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Clipped, Gauss, Scene, Soft, design, load_lens
from drt_jax.compilation import LARGE, jit
from drt_jax.design import (
    OPERANDS,
    Operand,
    Problem,
    Solve,
    Variables,
    operands,
    parts,
    perturbed,
    trace_fields,
    values,
)
from drt_jax.design.field_rays import relative_illumination
from drt_jax.design.parts import PARTS
from drt_jax.lens.glasses import glass_map_distance
from drt_jax.lens.paraxial import image_height
from drt_jax.pupil import pupil_points

from ..image.test_afocal import LENS as TELESCOPE
from .test_variables import MODEL

COLOURS, WEIGHTS = (0.48, 0.55, 0.65), np.array([0.25, 0.5, 0.25])
FIELDS, DISTANCES = np.radians([0.0, 14.0, 20.0]), (np.inf, 1000.0)
VIEWS = [(field, distance) for distance in DISTANCES for field in FIELDS]


def program(problem, kinds):
    """A function of the problem and the vector that returns the values of kinds by name."""

    def values(problem, vector):
        lens = problem.variables.lens_of(vector)
        rays = trace_fields(problem, lens)
        return {kind: Operand(kind).values(lens, rays) for kind in kinds}

    return jit(values, LARGE)


def values_of(lens, kinds, scene, rule):
    """The values of kinds, by name, of a given lens."""
    problem = Problem.from_variables(Variables.from_lens(lens, ["sensor"]), kinds, scene, rule)
    return program(problem, kinds)(problem, problem.variables.start)


@pytest.fixture(scope="module")
def triplet():
    """The Cooke triplet, the values of all operands, and the rule of its rays."""
    lens, rule = load_lens("cooke_triplet"), Gauss(4, "bilateral")
    variables = Variables.from_lens(lens, ["curvature"])
    none = "magnification", "glass_map"
    kinds = [k for k, value in OPERANDS.items() if k not in none and not value.of_waves]
    scene = Scene.grid(FIELDS, DISTANCES, COLOURS, wavelength_weights=WEIGHTS)
    problem = Problem.from_variables(variables, kinds, scene, rule)
    return lens, rule, program(problem, kinds)(problem, variables.start)


@pytest.mark.slow
def test_spots(triplet):
    """Sums of squares are traces of covariances, for wavelengths separately or together."""
    lens, rule, told = triplet
    for k, (field, distance) in enumerate(VIEWS):
        found = drt_jax.psf_moments(lens, Scene.point(field, distance, COLOURS), sampling=rule)
        mean, covariance = np.asarray(found.mean), np.asarray(found.covariance)
        apart = WEIGHTS @ np.trace(covariance, axis1=1, axis2=2)
        centroid = WEIGHTS @ mean
        whole = apart + WEIGHTS @ np.sum((mean - centroid) ** 2, axis=1)
        chief = np.asarray(drt_jax.image_point(lens, Scene.point(field, distance, COLOURS)))[1]

        def square(kind, k=k):  # of components, views, colours and rays
            return np.sum(told[kind].reshape(2, len(VIEWS), -1)[:, k] ** 2)

        assert abs(square("spot_of_colours") / apart - 1) < 1e-11
        assert abs(square("spot") / whole - 1) < 1e-11
        beside = np.sum((centroid - chief) ** 2)
        assert abs(square("spot_chief") / (whole + beside) - 1) < 1e-11
        assert abs(told["rms_spot"][k] / np.sqrt(whole) - 1) < 1e-11
        assert abs(told["centroid"][k] - centroid[1]) < 1e-12


@pytest.mark.slow
def test_wavefronts(triplet):
    lens, rule, told = triplet
    points, weights = (
        np.asarray(a)[0] for a in pupil_points(lens, Scene.point(0.1, np.inf, COLOURS), rule)
    )
    for k, (field, distance) in enumerate(VIEWS):
        wave = drt_jax.wavefront(lens, Scene.point(field, distance, COLOURS), points)
        rms = np.sqrt(WEIGHTS @ np.square(drt_jax.rms_wavefront(wave, weights)))
        assert abs(told["rms_wavefront"][k] / rms - 1) < 1e-9
        square = np.sum(told["path_difference"].reshape(len(VIEWS), -1)[k] ** 2)
        assert abs(square / rms**2 - 1) < 1e-9


def test_first_order(triplet):
    lens, _, told = triplet
    found = [drt_jax.first_order(lens, distance, COLOURS) for distance in DISTANCES]
    for kind in ("focal_length", "effective_focal_length", "back_focal_distance"):
        np.testing.assert_allclose(told[kind], getattr(found[0], kind)[1:2], rtol=1e-13)
    wide = 2 * found[0].entrance_pupil.semi_diameter[1]
    np.testing.assert_allclose(told["entrance_pupil"], [wide], rtol=1e-13)
    np.testing.assert_allclose(told["f_number"], [f.f_number[1] for f in found], rtol=1e-13)
    # The prescription is f/5, 10 mm; these are its printed values.
    assert abs(told["f_number"][0] - 5) < 2e-3 and abs(told["entrance_pupil"][0] - 10) < 3e-3
    ends = 3.25896 + 6.00755 + 0.99997 + 4.75041 + 2.95208
    assert abs(told["length"][0] - ends) < 1e-12
    assert abs(told["back_distance"][0] - 42.20778) < 1e-12
    assert abs(told["total_track"][0] - ends - 42.20778) < 1e-12


@pytest.mark.slow
def test_chief_rays(triplet):
    """Distortion and lateral colour agree with `image_point`, angles with the direction cosines."""
    lens, _, told = triplet
    focal = float(drt_jax.focal_length(lens, COLOURS[1])[0])
    for k, (field, distance) in enumerate(VIEWS):
        points = np.asarray(drt_jax.image_point(lens, Scene.point(field, distance, COLOURS)))[:, 1]
        lateral = told["lateral_colour"].reshape(len(VIEWS), 2)[k]
        np.testing.assert_allclose(lateral, points[1:] - points[0], atol=1e-13)
        if np.isinf(distance) and field:
            wanted = points[1] / (focal * np.tan(field)) - 1
            assert abs(told["distortion"][k] - wanted) < 1e-12
        ideal = image_height(lens, field, distance, COLOURS)[1]
        wanted = points[1] / ideal - 1 if field else 0
        assert abs(told["distortion"][k] - wanted) < 1e-12
        rays = drt_jax.trace_rays(lens, Scene.point(field, distance, COLOURS), [[0.0, 0.0]])
        angles = np.arccos(np.minimum(np.asarray(rays.directions)[:, 0, -1, 2], 1))
        np.testing.assert_allclose(
            told["chief_ray_angle"].reshape(len(VIEWS), 3)[k], angles, atol=1e-7 / (1 + 1e7 * field)
        )


@pytest.mark.slow
def test_numerical_apertures(triplet):
    """n sin of the angle between the chief ray and the marginal rays, by the direction cosines;
    close to the paraxial value on the axis."""
    lens, _, told = triplet
    rim = [[0.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [-1.0, 0.0]]
    for k, (field, distance) in enumerate(VIEWS):
        ends = np.asarray(
            drt_jax.trace_rays(lens, Scene.point(field, distance, COLOURS), rim).directions
        )[1, :, -1]
        sines = np.linalg.norm(np.cross(ends[0], ends[1:]), axis=-1)
        wanted = np.sqrt(np.mean(sines**2))
        assert abs(told["numerical_aperture"][k] / wanted - 1) < 1e-9
    paraxial = drt_jax.first_order(lens, np.inf, COLOURS[1]).numerical_aperture[0]
    assert abs(told["numerical_aperture"][0] / paraxial - 1) < 1e-2


@pytest.mark.slow
def test_incidence(triplet):
    """The largest angle between directions and normals; the normals are by differences of the
    sag."""
    lens, rule, told = triplet
    points = np.asarray(pupil_points(lens, Scene.point(0.1, np.inf, COLOURS), rule)[0])[0]
    points = np.concatenate([points, [[0, 0], [0, 1], [0, -1], [1, 0]]])
    largest, h = np.zeros(lens.count), 1e-4
    for field, distance in VIEWS:
        rays = drt_jax.trace_rays(lens, Scene.point(field, distance, COLOURS), points)
        for i in range(lens.count):
            x, y, _ = np.moveaxis(np.asarray(rays.points)[:, :, i], -1, 0)
            slopes = [
                (drt_jax.sag(lens, i, x + a, y + b) - drt_jax.sag(lens, i, x - a, y - b)) / (2 * h)
                for a, b in ((h, 0), (0, h))
            ]
            normal = np.stack([-slopes[0], -slopes[1], np.ones_like(x)], axis=-1)
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            cosine = np.sum(normal * np.asarray(rays.directions)[:, :, i], axis=-1)
            largest[i] = max(largest[i], np.arccos(np.min(cosine)))
    np.testing.assert_allclose(told["incidence_angle"], largest, atol=1e-7)


def test_thickness_at_edges(triplet):
    lens, _, told = triplet
    semi, zones = np.array(lens.semi_diameter), np.array([0.5, 0.7, 0.85, 1.0])
    gaps = np.append(lens.thickness, lens.sensor - np.sum(lens.thickness))
    semi[6] = semi[5]  # the sensor is wide enough
    for name, rows, wide in (("glass", (0, 2, 4), max), ("air", (1, 3, 5), min)):
        on_axis = gaps[list(rows)]
        np.testing.assert_allclose(told[f"{name}_centre"], on_axis, rtol=1e-14)
        for k, i in enumerate(rows):
            y = wide(semi[i], semi[i + 1]) * zones
            sags = [np.asarray(drt_jax.sag(lens, j, 0.0, y)) for j in (i, i + 1) if j < 6]
            sags = [*sags, 0 * y][:2]
            found = told[f"{name}_edge"].reshape(len(rows), 4)[k]
            np.testing.assert_allclose(found, on_axis[k] + sags[1] - sags[0], rtol=1e-13)


@pytest.mark.slow
def test_open_apertures_reach_as_far_as_the_rays(tmp_path):
    lens = model(tmp_path)
    problem = Problem.from_variables(
        Variables.from_lens(lens, ["thickness"]), ["air_edge"], Scene.radians([0.0, 0.2]), 3
    )
    extents = np.asarray(problem.beam_radius(lens))
    assert extents[0] == 6 and extents[4] == 4
    rays = drt_jax.trace_rays(lens, Scene.point(0.2, np.inf, 0.5875618), [[0, 1], [0, -1], [1, 0]])
    reach = np.hypot(*np.moveaxis(np.asarray(rays.points)[0, :, :, :2], -1, 0)).max(axis=0)
    np.testing.assert_allclose(extents[[1, 2, 3, 5, 6]], reach[[1, 2, 3, 5, 6]], rtol=1e-12)


def flux(lens, field, count=400, h=1e-4):
    """Light of a distant object on the sensor: the area of the beam in the plane z = 0, times the
    solid angle, in direction cosines, of the part of the object that is imaged onto an area of the
    sensor."""
    angle = 2 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rays = drt_jax.trace_rays(lens, Scene.point(field, np.inf, COLOURS[1]), rim)
    point, line = (np.asarray(a)[0, :, 0] for a in (rays.points, rays.directions))
    x, y, _ = (point - line * (point[:, 2] / line[:, 2])[:, None]).T
    area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    columns = []
    for step in np.eye(2) * h:
        ends = [np.array([0, field]) + sign * step for sign in (1, -1)]
        hits = [
            np.asarray(drt_jax.image_point(lens, Scene.point(e, np.inf, COLOURS[1])))[0]
            for e in ends
        ]
        lines = [np.tan(e) / np.sqrt(1 + np.sum(np.tan(e) ** 2)) for e in ends]
        columns.append((hits[0] - hits[1], lines[0] - lines[1]))
    moved, turned = (np.linalg.det(np.stack(part)) for part in zip(*columns))
    return area * abs(turned / moved)


@pytest.mark.slow
def test_illumination_is_what_a_beam_brings(triplet):
    lens, _, told = triplet
    light = np.array([flux(lens, field) for field in FIELDS])
    np.testing.assert_allclose(told["relative_illumination"][:3], light / light[0], rtol=5e-3)
    assert told["relative_illumination"][3] == 1


DOUBLET = {
    "surfaces": [
        {"radius": 61.0, "thickness": 6, "glass": "N-BK7", "semi_diameter": 12, "stop": True},
        {"radius": -44.0, "thickness": 2.5, "glass": "F2"},
        {"radius": -129.0, "thickness": 96.0},
    ]
}
WEAK = """
surfaces:
  - {{radius: inf, thickness: 60, semi_diameter: {semi}}}
  - {{radius: inf, thickness: 0.1, semi_diameter: 2, stop: true}}
  - {{radius: 207.2, thickness: 0.1, index: 1.518}}
  - {{radius: -207.2, thickness: 199.9}}
"""


@pytest.mark.slow
@pytest.mark.parametrize("semi, rule", [(100, 4), (15, Clipped(6, "bilateral"))])
def test_illumination_of_a_thin_lens(tmp_path, semi, rule):
    """The fourth power of the cosine, times the fraction of the light that passes a clear aperture
    far in front."""
    path = tmp_path / "weak.yaml"
    path.write_text(WEAK.format(semi=semi))
    lens = load_lens(path)
    fields = np.radians([0.0, 14.0])
    problem = Problem.from_variables(
        Variables.from_lens(lens, ["thickness"]), ["spot"], Scene.radians(fields), rule
    )

    @jax.jit
    def told(lens):
        rays = trace_fields(problem, lens)
        return relative_illumination(lens, rays), rays.throughput

    found, passed = told(lens)
    share = passed[1, 0] / passed[0, 0]
    assert share == 1 if semi == 100 else 0.4 < share < 0.6
    # The open part of the stop lies on one side of its centre.
    near = 2e-3 if semi == 100 else 1e-2
    assert abs(found[1] / (np.cos(fields[1]) ** 4 * share) - 1) < near


@pytest.mark.slow
def test_operands_of_an_afocal_lens_are_its_analyses():
    """Angles and the light on a pixel agree with the analyses, there is no paraxial image, and the
    centroid on the axis is 0."""
    scene, rule = Scene.radians([0.0, 0.002, 0.004], np.inf, 0.5), Gauss(6, "bilateral")
    told = values_of(TELESCOPE, ["chief_ray_angle", "relative_illumination"], scene, rule)
    angles = drt_jax.chief_ray_angle(TELESCOPE, scene)[:, 0]
    np.testing.assert_allclose(told["chief_ray_angle"], angles, rtol=1e-12)
    light = drt_jax.relative_illumination(TELESCOPE, scene, rule, "sensor")[:, 0]
    np.testing.assert_allclose(told["relative_illumination"], light, rtol=1e-12)
    with pytest.raises(ValueError, match="distortion: an afocal lens has no image height"):
        values_of(TELESCOPE, ["distortion"], scene, rule)


@pytest.mark.slow
def test_a_centroid_on_the_axis_is_there():
    """Rays on one radius represent all azimuths."""
    lens, scene = load_lens("singlet"), Scene.radians([0.0], np.inf, COLOURS)
    told = values_of(lens, ["centroid", "rms_spot"], scene, Gauss(4, "rotational"))
    whole = values_of(lens, ["rms_spot"], scene, Gauss(4, "none"))
    np.testing.assert_allclose(told["rms_spot"], whole["rms_spot"], rtol=1e-12)
    np.testing.assert_array_equal(told["centroid"], [0.0])


@pytest.mark.slow
def test_vignetted_spots():
    """Spots by a rule fitted to the open part of the pupil."""
    lens, rule, field = load_lens("camera_50mm"), Clipped(4, "bilateral"), np.radians(20)
    problem = Problem.from_variables(
        Variables.from_lens(lens, ["thickness"]),
        ["spot_of_colours"],
        Scene.radians([field], wavelengths=COLOURS[1]),
        rule,
    )

    @jax.jit
    def told(lens):
        rays = trace_fields(problem, lens)
        return problem.operands[0].values(lens, rays), rays.throughput

    values, passed = told(lens)
    found = drt_jax.psf_moments(lens, Scene.point(field, np.inf, COLOURS[1]), sampling=rule)
    assert 0.3 < passed[0, 0] < 0.9 and abs(passed[0, 0] / found.throughput[0] - 1) < 1e-11
    trace = np.trace(np.asarray(found.covariance)[0])
    assert abs(np.sum(values**2) / trace - 1) < 1e-10


def beam(lens, vary, rule, **given):
    """A problem of the Petzval lens with two fields, of which clear apertures clip the second."""
    fields = np.radians([0.0, 8.0])
    kinds = ("spot", "rms_spot", "rms_wavefront", "centroid")
    wanted = [*(Operand(kind, **given) for kind in kinds), "throughput"]
    return Problem.from_variables(
        Variables.from_lens(lens, vary), wanted, Scene.radians(fields, wavelengths=COLOURS), rule
    )


@jax.jit
def judged(problem, lens):
    rays = trace_fields(problem, lens)
    return [operand.values(lens, rays) for operand in problem.operands]


@pytest.mark.slow
def test_spots_without_vignetting():
    """Spots are those of the lens without clear apertures: narrower apertures change light and
    vignetted spots, but not these."""
    lens, rule = load_lens("petzval_100mm"), Gauss(6, "bilateral")
    narrow = dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[5].set(13.0))
    free = jnp.full_like(lens.semi_diameter, jnp.inf)
    free = free.at[lens.stop].set(lens.semi_diameter[lens.stop])
    free = dataclasses.replace(lens, semi_diameter=free)
    usual, whole = (
        [judged(beam(lens, ["sensor"], rule, **given), each) for each in (lens, narrow, free)]
        for given in ({}, {"vignetting": False})
    )
    assert usual[0][4][1] > usual[1][4][1] + 0.1 and np.all(usual[2][4] == 1)
    assert usual[1][1][1] < 0.9 * usual[0][1][1] < 0.9 * usual[2][1][1]
    for one, two, three, wanted in zip(*(found[:4] for found in whole), usual[2]):
        np.testing.assert_array_equal(one, two)
        np.testing.assert_allclose(one, wanted, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(three, wanted, rtol=1e-12, atol=1e-15)
    with pytest.raises(ValueError, match="vignetting: Clipped traces only what passes"):
        beam(lens, ["sensor"], Clipped(3, "bilateral"), vignetting=False)


@pytest.mark.slow
def test_apertures_as_variables_do_not_vignette():
    """With spots of the light that arrives, apertures close; with spots of the whole stop they stay
    open."""
    lens, rule = load_lens("petzval_100mm"), Soft(5, "bilateral", 1.0)
    vary = ["sensor", design.Vary("curvature", (5,))]
    vary.append(design.Vary("semi_diameter", (3, 4, 5), low=10.0, high=25.0))
    scene = Scene.degrees([0.0, 3.0, 5.5], wavelengths=COLOURS)
    light = []
    for operand in (Operand("spot"), Operand("spot", vignetting=False)):
        problem = Problem.from_variables(Variables.from_lens(lens, vary), [operand], scene, rule)
        before = trace_fields(problem, problem.variables.lens).throughput
        after = trace_fields(problem, design.optimise(problem).lens).throughput
        light.append(float(np.mean(after[2]) / np.mean(before[2])))
    assert light[0] < 0.8 and abs(light[1] - 1) < 0.01


@pytest.mark.slow
def test_glasses_stay_on_the_map():
    """A doublet with variable glasses: without the limit they end in a region without glasses."""
    lens = drt_jax.with_model_glass(load_lens(DOUBLET))
    free = ["curvature", "index", "abbe", "sensor"]
    variables = Variables.from_lens(lens, free, solves=[Solve("focal_length", 100.0, surface=2)])
    ends = []
    for limits in ([], [Operand("glass_map", high=0.0)]):
        problem = Problem.from_variables(
            variables, ["spot", *limits], Scene.radians([0.0, 0.02], wavelengths=COLOURS), 3
        )
        found = design.optimise(problem, max_steps=60)
        model = found.lens.dispersion.model[jnp.array([1, 2])]
        ends.append(np.asarray(glass_map_distance(model)))
        if limits:
            assert found.max_violation == 0 and {limit.where for limit in found.limits} == {
                "surface 0",
                "surface 1",
            }
    assert np.max(ends[0]) > 0.01 and np.max(ends[1]) <= 1e-12


def model(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(MODEL)
    return load_lens(path)


@pytest.mark.slow
def test_a_dark_field_is_no_good_one(tmp_path):
    lens = model(tmp_path)
    lens = dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[6].set(1e-3))
    problem = Problem.from_variables(
        Variables.from_lens(lens, ["curvature"]), ["spot"], Scene.radians([0.3]), 3
    )
    merit, gradient = jax.jit(jax.value_and_grad(problem.merit))(problem.variables.start)
    assert np.isinf(merit) and np.all(np.isfinite(gradient))
    with pytest.raises(ValueError, match="the start cannot be evaluated"):
        design.optimise(problem, max_steps=2)


def test_obscurations_need_another_rule():
    lens = load_lens("hubble")
    problem = Problem.from_variables(
        Variables.from_lens(lens, ["sensor"]), ["spot"], sampling=Clipped(3, "none")
    )
    if lens.apertures is not None and any(lens.apertures.blocks):
        with pytest.raises(ValueError, match="rule: Clipped gives negative weights"):
            problem.merit(problem.variables.start)


@pytest.mark.parametrize(
    "arguments, said",
    [
        (dict(kind="blur"), "operands: kind: expected one of spot,"),
        (dict(kind="rms_spot", low=1, high=0), "operands: rms_spot: low 1 is not below high 0"),
        (dict(kind="rms_spot", low=1, high=1), "both 1; give it as the target"),
        (dict(kind="rms_spot", low=np.nan), "low nan is not below"),
        (
            dict(kind="rms_spot", weight=-1),
            "rms_spot: weight: must be above 0, or 0 to leave it out",
        ),
        (dict(kind="length", vignetting=False), "vignetting: only for spot, spot_of_colours,"),
        (dict(kind="centroid", target=np.inf), "operands: centroid: target: must be finite"),
        (dict(kind="length", target=3, high=4), "has a target and limits; make two operands"),
        (dict(kind="spot", high=0.1), "spot: takes no target and no limits; use rms_spot"),
        (dict(kind="length", fields=(0,)), "length: does not depend on fields; remove fields"),
        (
            dict(kind="focal_length", distances=(0,)),
            "does not depend on distances, only on wavelengths",
        ),
        (dict(kind="mtf", target=1), "mtf: at: missing; give the frequency of an mtf in cycles/mm"),
        (dict(kind="mtf", target=1, at=-5), "mtf: at: must be above 0 and finite, got -5"),
        (dict(kind="mtf", at=50), "mtf: target: 0 means no light; give 1 for the best, or limits"),
        (dict(kind="spot", at=50), "spot: at: only mtf and encircled_energy have it; leave it out"),
        (dict(kind="spot", fields=0), "operands: spot: fields: expected whole numbers"),
        (dict(kind="spot", fields=("x",)), "operands: spot: fields: expected whole numbers"),
    ],
)
def test_bad_words_and_numbers(arguments, said):
    with pytest.raises(ValueError) as told:
        Operand(**arguments)
    assert said in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize(
    "operand, said",
    [
        (Operand("spot", fields=(2,)), "operands: spot: fields: no number 2; there are 0, 1"),
        (Operand("spot", wavelengths=(-1,)), "wavelengths: no number -1; there are 0"),
        (Operand("glass_edge", surfaces=(1,)), "glass_edge: surfaces: no number 1; there are 0, 2"),
        (Operand("incidence_angle", surfaces=(4,)), "no number 4; there are 0, 1, 2, 3, 5, 6"),
        (Operand("lateral_colour"), "lateral_colour: wavelengths: needs two or more; leave it out"),
        (Operand("magnification"), "operands: magnification: the object is at infinity"),
    ],
)
def test_what_neither_lens_nor_problem_has(tmp_path, operand, said):
    variables = Variables.from_lens(model(tmp_path), ["curvature"])
    with pytest.raises(ValueError) as told:
        Problem.from_variables(variables, [operand], Scene.radians([0.0, 0.1]))
    assert said in str(told.value)
    assert hash(Operand("spot", fields=[0]))


def test_each_kind_is_told_where_a_user_reads():
    page = (pathlib.Path(__file__).parents[2] / "docs" / "design.md").read_text()
    for kind in OPERANDS:
        assert f"`{kind}`" in page and kind in values.__doc__
    for kind in PARTS:
        assert f"`{kind}`" in page
    for kind in get_args(Solve.__annotations__["kind"]):
        assert f"`{kind}`" in page


def test_kinds_as_type_checkers_know_them():
    known = ((operands.OperandName, OPERANDS), (parts.VariableKind, PARTS))
    for literal, table in (*known, (perturbed.ToleranceKind, perturbed.KINDS)):
        assert get_args(literal) == tuple(table)


def test_words_of_other_programs_are_answered():
    words = {"EFFL": "effective_focal_length", "totr": "total_track", "MNCA": "air_centre"}
    for word, kind in (words | {"OAL": "length", "RSCH": "spot_chief"}).items():
        with pytest.raises(ValueError, match=f"got '{word}'; did you mean '{kind}'"):
            Operand(word)
    assert {*operands._ELSEWHERE.values()} <= {*design.OPERANDS}
