"""Prescriptions and printed numbers of other programs, with the Fermat tracer.

The cases are those of reference_cases.yaml and psf_cases.yaml, named by their id. Where a listing
labels rays by their height in front of the lens, a stop plane in the same medium does so here; it
may lie in front of the first surface, at its vertex or behind it.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, Status, load_lens, pupil, trace_rays
from drt_jax.lens.forms import Shape
from drt_jax.lens.lens import Labels
from drt_jax.lens.paraxial import image_height, trace_yu
from drt_jax.lens.surface import sag_derivatives, surface_sag

from .. import oracle
from .traced import assert_same_rays, behind_stop, directions, hexapolar, on_y, truth

INF = np.inf


def focus(points, vertex):
    """Intersections of rays (Q, S + 1, 3) with the axis behind their last surface, mm from
    `vertex`."""
    (y0, z0), (y1, z1) = points[:, -2, 1:].T, points[:, -1, 1:].T
    return z0 - y0 * (z1 - z0) / (y1 - y0) - vertex


# C01, C02: Double Gauss f/2, ag_dblgauss.seq and ag_dblgauss.lis (CODE V 10.8, 29-Jun-2017).


def double_gauss(cases):
    """Surfaces of C01 as in a prescription, by glass."""
    entry = cases["C01"]["prescription"]
    surfaces = [
        {"curvature": row["c"], "thickness": row["t"], "glass": glass}
        for row, glass in zip(entry["surfaces"], entry["glasses"])
    ]
    surfaces[-1]["thickness"] += entry["image_defocus"]
    return surfaces


def double_gauss_lens(cases):
    surfaces = double_gauss(cases)
    stop = cases["C02"]["reference"]["y_marginal"][5]
    surfaces[5] |= {"stop": True, "semi_diameter": stop}
    return load_lens({"surfaces": surfaces})


@pytest.mark.parametrize("gap", [10.0, 0.0, -3.0])
def test_c01_marginal_ray(cases, gap):
    """x, z, slope and distance at each surface to half a unit of the sixth decimal; angles of
    incidence to that of the second, in degrees. The rim of the first surface lies 5.9 mm behind its
    vertex, so that it crosses a stop that is closer."""
    lens = behind_stop(double_gauss(cases), gap, 25.0)
    rays = trace_rays(lens, Scene.point(0.0, INF, [0.5876]), on_y(1.0, 0.8, 0.6, 0.4))
    points = np.asarray(rays.points[0, 0, 1:])
    d = np.asarray(rays.directions[0, 0, 1:])
    vertex = np.asarray(lens.vertices[1:])
    reference = cases["C01"]["reference"]
    printed = np.array([row[1:] for row in reference["rows"]], float)
    np.testing.assert_allclose(points[:, 1], printed[:, 0], atol=5.1e-7)
    np.testing.assert_allclose(points[:, 2] - vertex, printed[:, 1], atol=5.1e-7)
    np.testing.assert_allclose(d[1:, 1] / d[1:, 2], printed[:-1, 2], atol=5.1e-7)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    np.testing.assert_allclose(length, printed[:-1, 3], atol=5.1e-7)
    shape = Shape(lens.curvature[1:-1], lens.conic[1:-1], jnp.zeros((0, 11)))
    slope = np.asarray(sag_derivatives(jnp.asarray(points[:-1, :2].T), shape)[1])
    normal = np.stack([-slope[0], -slope[1], np.ones(11)], axis=1)
    cosine = np.sum(normal * d[:-1], axis=1) / np.linalg.norm(normal, axis=1)
    angle = np.degrees(np.arccos(np.minimum(cosine, 1)))
    np.testing.assert_allclose(angle, reference["angle_of_incidence_deg"], atol=5.1e-3)


@pytest.mark.slow
def test_c01_ray_errors_and_path_differences(cases):
    """Transverse errors to half a unit of the sixth decimal; OPD to 0.002 waves."""
    reference = cases["C01"]["reference"]
    parts = reference["dx_mm"]
    labelled = behind_stop(double_gauss(cases), 10.0, 25.0)
    rays = trace_rays(labelled, Scene.point(0.0, INF, [0.5876]), on_y(*map(float, parts)))
    np.testing.assert_allclose(rays.points[0, :, -1, 1], [*parts.values()], atol=5.1e-7)
    lens = double_gauss_lens(cases)
    pupil = rays.points[0, :, 6, :2] / lens.semi_diameter[5]
    wave = drt_jax.wavefront(lens, Scene.point(0.0, INF, [0.5876]), pupil)
    assert np.all(wave.status == Status.OK)
    np.testing.assert_allclose(wave.opd[0], [*reference["opd_waves"].values()], atol=0.002)


def test_c02_first_order_data(cases):
    """Lengths and f-number to half a unit of the fourth decimal, indices to that of the sixth."""
    reference = cases["C02"]["reference"]
    lens, d = double_gauss_lens(cases), jnp.array([0.5876])
    first = drt_jax.first_order(lens, INF, d)
    height = image_height(lens, np.radians(14), INF, d)
    entrance, leaving = reference["entrance_pupil"], reference["exit_pupil"]
    pairs = [
        (first.focal_length, reference["EFL"]),
        (first.back_focal_distance, reference["BFL"]),
        (first.front_focal_distance, reference["FFL"]),
        (first.f_number, reference["FNO"]),
        (lens.vertices[-2:-1], reference["OAL"]),
        (height, reference["image_height_14deg"]),
        (2 * first.entrance_pupil.semi_diameter, entrance["dia"]),
        (first.entrance_pupil.position, entrance["from_surf1"]),
        (2 * first.exit_pupil.semi_diameter, leaving["dia"]),
        (first.exit_pupil.position, leaving["from_surf11"]),
    ]
    ours, printed = (np.array([np.squeeze(pair[k]) for pair in pairs]) for k in (0, 1))
    np.testing.assert_allclose(ours, printed, atol=5.1e-5)
    n = lens.index(jnp.array(reference["indices"].pop("at_nm")) / 1e3)
    for glass, printed in reference["indices"].items():
        np.testing.assert_allclose(n[lens.glasses.index(glass)], printed, atol=5.1e-7)


@pytest.mark.slow
def test_c02_paraxial_rays(cases):
    """Heights and slopes at each surface to half a unit of the sixth decimal; Fermat rays at a ten
    thousandth of the aperture have the heights of the paraxial marginal ray."""
    reference = cases["C02"]["reference"]
    lens, d = double_gauss_lens(cases), jnp.array([0.5876])
    tangent = np.tan(np.radians(14))
    pupil = drt_jax.first_order(lens, jnp.inf, d).entrance_pupil
    starts = {
        "marginal": (pupil.semi_diameter, jnp.zeros(1)),
        "chief": (-tangent * pupil.position, jnp.full(1, tangent)),
    }
    for name, start in starts.items():
        index = lens.index(d)
        power = lens.curvature[:-1, None] * jnp.diff(index, axis=0)
        y, u = trace_yu(power, lens.thickness, index, *start)
        suffix = "_14deg" if name == "chief" else ""
        np.testing.assert_allclose(y[:, 0], reference[f"y_{name}{suffix}"], atol=6e-7)
        np.testing.assert_allclose(u[:, 0], reference[f"u_{name}_after"], atol=6e-7)
    rays = trace_rays(lens, Scene.point(0.0, INF, d), on_y(1e-4))
    heights = rays.points[0, 0, :-1, 1] / 1e-4
    np.testing.assert_allclose(heights, reference["y_marginal"], atol=1.5e-6)


def test_c02_third_order_sums(cases):
    """Transverse, in mm, to half a unit of the sixth decimal."""
    lens = double_gauss_lens(cases)
    colours = jnp.array([0.6563, 0.5876, 0.4861])
    total = drt_jax.third_order(lens, Scene.point(np.radians(14), INF, colours)).total
    printed = cases["C02"]["reference"]["third_order_transverse_sums_mm"]
    assert list(printed) == ["SA", "TCO", "TAS", "SAS", "PTB", "DST", "AX", "LAT", "PTZ"]
    np.testing.assert_allclose([a[1] for a in total], [*printed.values()], atol=5.1e-7)


# C08: LSST, three mirrors and six lens surfaces, Zemax through batoid's test data.


@pytest.fixture
def lsst(cases):
    entry = cases["C08"]["prescription"]
    pupil, rows = entry["entrance_pupil"], entry["surfaces"]
    z = [pupil["z"], *(row["z"] for row in rows)]
    surfaces = [
        {
            "radius": row["R"],
            "conic": row.get("k", 0.0),
            "coefficients": row.get("A", {}),
            "thickness": after - here,
            **({"mirror": True} if "mirror" in row else {"index": row["n_after"]}),
        }
        for row, here, after in zip(rows[:-1], z[1:], z[2:])
    ]
    return behind_stop(surfaces, -pupil["z"], pupil["radius"])


@pytest.mark.parametrize("name", ["LSST_trace_0", "LSST_trace_1", "LSST_trace_2"])
def test_c08_rays(cases, lsst, name):
    """Positions to 1e-6 mm, which are printed to 1e-7 mm, cosines to 3e-10."""
    rows = np.array(cases["C08"]["reference"]["rays"][name])[:, 1:]
    start, cosines = rows[0, :3], rows[:, 3:]
    field = np.arctan(cosines[0, :2] / cosines[0, 2])
    rays = trace_rays(lsst, Scene.point(field, INF, [0.5]), [start[:2] / 4180.0])
    assert rays.status.item() == Status.OK
    points = np.asarray(rays.points[0, 0])
    np.testing.assert_allclose(points + np.array([0, 0, start[2]]), rows[:, :3], atol=1e-6)
    ours = directions(points)
    np.testing.assert_allclose(np.abs(ours), np.abs(cosines[:-1]), atol=3e-10)


@pytest.mark.slow
def test_c08_whole_pupil(cases, lsst):
    """The plane of the entrance pupil touches the rim of the first mirror, within 1e-5 mm: every
    ray of the stop agrees with the oracle to 1e-8 mm of 12 m."""
    field = np.radians([0.7, 1.2])
    points = hexapolar(4)
    wanted = truth(oracle.Scene.of(lsst, field, INF, [0.5]), points)
    assert np.all(wanted.exists)
    depth = wanted.points[0, :, 1, 2]
    assert -2e-5 < np.min(depth) < 0 and np.max(depth) > 400
    assert_same_rays(trace_rays(lsst, Scene.point(field, INF, [0.5]), points), wanted, 1e-8)


# C13: a toroid, Zemax through Optiland's tests.


@pytest.mark.slow
@pytest.mark.parametrize("gap", [2.0, 0.0, -2.0])
def test_c13_toroid(cases, gap):
    """Rays and sag to 1e-11, for any position of the stop that labels them."""
    entry, reference = cases["C13"]["prescription"], cases["C13"]["reference"]
    a1, a2 = entry["a"]
    toroid = {
        "form": "toroid",
        "radius": entry["Ry"],
        "conic": entry["k"],
        "radius_x": entry["Rx"],
        "coefficients": {2: a1, 4: a2},
        "thickness": entry["thickness"],
        "index": entry["n"],
    }
    lens = behind_stop([toroid, {"radius": INF, "thickness": 10.0}], gap, 5.0)
    starts = np.array([ray["start"] for ray in reference["rays"]])
    rays = trace_rays(lens, Scene.point(0.0, INF, [0.55]), starts / 5.0)
    points = np.asarray(rays.points[0])
    ours = {"x": points[:, -1, 0], "y": points[:, -1, 1]}
    ours |= dict(zip("LMN", directions(points)[:, -1].T))
    for i, ray in enumerate(reference["rays"]):
        for key in ray.keys() - {"start"}:
            np.testing.assert_allclose(ours[key][i], ray[key], atol=1e-11)
    shape = Shape(*map(jnp.array, (1 / entry["Ry"], entry["k"], [1 / entry["Rx"], 1e-5])))
    for x, y, height in reference["sag_for_a1_1e_5_a2_0"]:
        ours = surface_sag((jnp.array(x), jnp.array(y)), shape, "toroid")
        np.testing.assert_allclose(ours, height, atol=1e-11)


# C16: Wyld's achromat, John Walker's fbench.

LINES = {"D": 5895.944, "C": 6562.816, "F": 4861.344}


def wyld(entry, line):
    """The telescope of C16 with the constant indices of one wavelength."""
    part = (LINES["D"] - LINES[line]) / (LINES["C"] - LINES["F"])
    surfaces = []
    for row in entry["surfaces"]:
        n = row["n_D"] + part * (row["n_D"] - 1) / row["V"] if "V" in row else 1.0
        surfaces.append({"radius": row["R"], "index": n, "thickness": row.get("t", 50.0)})
    lens = behind_stop(surfaces, 1.0, entry["height"])
    labels = Labels("", tuple("abcdef"))  # one program for all lines
    return dataclasses.replace(lens, labels=labels)


@pytest.mark.slow
def test_c16_wyld_achromat(cases):
    """Eleven decimals are published: 1e-10 in the foci, some 1e-11 in slopes and differences."""
    entry, reference = cases["C16"]["prescription"], cases["C16"]["reference"]
    foci, slopes = {}, {}
    for line in LINES:
        lens = wyld(entry, line)
        points = np.asarray(trace_rays(lens, Scene.point(0.0, INF, [0.55]), on_y(1.0)).points[0])
        foci[line] = focus(points, lens.vertices[-2])[0]
        slopes[line] = np.arcsin(-directions(points)[0, -1, 1])
    lens = wyld(entry, "D")
    first = drt_jax.first_order(lens, INF, jnp.array([0.55]))
    paraxial = first.back_focal_distance.item()
    u = entry["height"] / first.focal_length.item()
    sine = 1 - paraxial * u / (np.sin(slopes["D"]) * foci["D"])
    pairs = {
        "marginal_back_focus": foci["D"],
        "marginal_slope_rad": slopes["D"],
        "paraxial_back_focus": paraxial,
        "paraxial_slope": u,
        "long_spherical": paraxial - foci["D"],
        "offense_sine_condition": sine,
        "axial_chromatic_F_minus_C": foci["F"] - foci["C"],
    }
    for key, ours in pairs.items():
        np.testing.assert_allclose(ours, reference[key], atol=5.1e-11, err_msg=key)


# P01: a biconvex singlet behind a stop that touches it, OpticStudio 25.1.1 through ZOSPy's tests.


@pytest.fixture
def p01(cases):
    rows = [
        {
            "radius": row["R"],
            "thickness": row["t"],
            **(
                {"stop": True, "semi_diameter": 1.0} if "stop" in row else {"index": row["n_after"]}
            ),
        }
        for row in cases["P01"]["prescription"]["surfaces"]
    ]
    return load_lens({"surfaces": rows})


@pytest.mark.slow
def test_p01_ray_fan(cases, p01):
    """Transverse errors to 1e-10 um."""
    fan = np.array(cases["P01"]["reference"]["tangential_fan_py_ey_um"])
    both = np.concatenate([fan, -fan])  # it is odd
    rays = trace_rays(p01, Scene.point(0.0, INF, [0.543]), on_y(*both[:, 0]))
    assert np.all(rays.status == Status.OK)
    np.testing.assert_allclose(1e3 * rays.points[0, :, -1, 1], both[:, 1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(rays.points[0, :, -1, 0], 0, atol=1e-15)


def test_p01_first_order(cases, p01):
    """To half a unit of the last printed digit."""
    reference = cases["P01"]["reference"]["first_order"]
    first = drt_jax.first_order(p01, INF, jnp.array([0.543]))
    np.testing.assert_allclose(first.focal_length, reference["focal_length_cardinal"], atol=5.1e-7)
    np.testing.assert_allclose(first.back_focal_distance, reference["BFL"], atol=5.1e-6)
    np.testing.assert_allclose(first.f_number, reference["paraxial_fno"], atol=5.1e-6)
    pupil = first.exit_pupil
    np.testing.assert_allclose(
        2 * pupil.semi_diameter, reference["exit_pupil_diameter"], atol=5.1e-7
    )
    # From the image; ours is from the last vertex.
    place = pupil.position - (p01.sensor - p01.vertices[-2])
    np.testing.assert_allclose(place, reference["exit_pupil_from_image"], atol=5.1e-6)


@pytest.mark.slow
def test_p01_wavefront(cases, p01):
    """Zernike coefficients and root mean square to half a unit of the last digit, which is 1e-8
    waves; the range, which is that of a 64 x 64 grid, to 1e-6 waves."""
    reference = cases["P01"]["reference"]
    points, weights = pupil.disc(8, 9)
    edge = on_y(*np.linspace(0, 1, 401))
    wave = drt_jax.wavefront(p01, Scene.point(0.0, INF, [0.543]), np.concatenate([points, edge]))
    assert np.all(wave.status == Status.OK)
    opd = np.asarray(wave.opd[0, : len(weights)])
    t = np.sum(points**2, axis=-1)
    radial = {
        "Z1": np.ones_like(t),
        "Z4": np.sqrt(3) * (2 * t - 1),
        "Z11": np.sqrt(5) * (6 * t**2 - 6 * t + 1),
        "Z22": np.sqrt(7) * (20 * t**3 - 30 * t**2 + 12 * t - 1),
    }
    for name, printed in reference["zernike_standard_nonzero"].items():
        ours = np.sum(weights * opd * radial[name])
        np.testing.assert_allclose(ours, printed, rtol=0, atol=5.1e-9, err_msg=name)
    rms = drt_jax.rms_wavefront(wave, np.concatenate([weights, np.zeros(len(edge))]))
    np.testing.assert_allclose(rms, reference["rms_wave_converged"], rtol=0, atol=5.1e-9)
    np.testing.assert_allclose(np.ptp(wave.opd), reference["pv_wave"], rtol=0, atol=1e-6)
