"""Elements split, bent and cemented, plates and dummies inserted, lenses joined."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design, load_lens, trace_rays

from .. import oracle

PUPIL = np.array([[0.0, 0.0], [0.6, -0.3], [-0.2, 0.8], [0.0, -0.9]])
GLASS, WAVE = drt_jax.find_glass("N-BK7"), 0.5875618


def traced(lens, scene):
    """Points and paths of rays by an independent trace, which compiles nothing."""
    return oracle.rays_of(lens, scene, PUPIL)


def first_order(lens, distance=np.inf):
    return drt_jax.first_order(lens, distance, WAVE)


def schlieren(shared):
    """A lens file with two mirrors and four coordinate breaks."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return drt_jax.load_system(shared / "lens_files" / "schlieren_system.zmx")


def power_by_matrices(lens, first, last):
    """Power of spherical surfaces in their media, from 2 x 2 matrices of (y, n u)."""
    n = np.asarray(lens.index(WAVE))[:, 0]
    whole = np.eye(2)
    for i in range(first, last + 1):
        face = np.array([[1, 0], [-(n[i + 1] - n[i]) * float(lens.curvature[i]), 1]])
        gap = float(lens.thickness[i]) if i < last else 0.0
        whole = np.array([[1, gap / n[i + 1]], [0, 1]]) @ face @ whole
    return -whole[1, 0]


def snell_errors(lens, points, wavelengths):
    """Largest difference of n sin in front of a spherical surface and behind it, from the points of
    rays."""
    z = np.asarray(lens.vertices)
    bend = np.asarray(lens.curvature)[:, None]
    index = np.asarray(lens.index(wavelengths)).T[:, None, :, None]
    normal = bend * (points - z[:, None] * [0, 0, 1]) - [0, 0, 1]
    steps = np.diff(points, axis=-2)
    along = steps / np.linalg.norm(steps, axis=-1, keepdims=True)
    inner = normal[..., 1:-1, :] / np.linalg.norm(normal[..., 1:-1, :], axis=-1, keepdims=True)
    before = index[..., 1:-1, :] * np.cross(along[..., :-1, :], inner)
    behind = index[..., 2:, :] * np.cross(along[..., 1:, :], inner)
    return np.max(np.abs(before - behind))


SCENE = Scene.degrees([[0, 0], [3, 8]], 2e3, (0.6, 0.48))


@pytest.mark.parametrize(
    "surface, distance, curvature",
    [(0, 1.5, None), (0, 1.5, 0.02), (1, 9.0, None), (5, 20.0, -0.01), (2, -0.3, None)],
)
def test_a_dummy_changes_no_ray(surface, distance, curvature):
    """In glass, in air, out of order, behind the last surface; plane and curved."""
    lens = load_lens("cooke_triplet")
    more = design.with_dummy(lens, surface, distance, curvature)
    assert more.active == tuple(i + (i > surface) for i in lens.active)
    (one, path), (two, longer) = traced(lens, SCENE), traced(more, SCENE)
    kept = np.delete(np.arange(more.count + 1), surface + 1)
    np.testing.assert_allclose(two[..., kept, :], one, rtol=0, atol=1e-12)
    np.testing.assert_allclose(longer, path, rtol=0, atol=1e-11)
    z = np.asarray(lens.vertices)[surface] + distance
    w = two[..., surface + 1, :]
    bend = curvature or 0.0
    sag = bend * np.sum((w - [0, 0, z]) ** 2, axis=-1) / 2  # of a sphere: c (r^2 + s^2) / 2
    np.testing.assert_allclose(w[..., 2] - z, sag, rtol=0, atol=1e-12)
    back = design.removed(more, (surface + 1,))
    for a, b in zip(jax.tree.leaves(lens), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def test_a_stop_inside_of_an_element():
    lens = design.with_dummy(load_lens("cooke_triplet"), 0, 1.5)
    inside = design.with_stop(lens, 1)
    rays = trace_rays(design.open_apertures(inside), SCENE, PUPIL)
    assert np.all(rays.status == 0)
    points = np.asarray(rays.points)
    on_stop = points[..., 1, :2] / inside.semi_diameter[1]
    np.testing.assert_allclose(on_stop, np.broadcast_to(PUPIL, on_stop.shape), atol=1e-12)
    assert snell_errors(inside, points, SCENE.wavelengths) < 1e-12
    np.testing.assert_allclose(first_order(inside).f_number, first_order(lens).f_number, rtol=1e-12)


@pytest.mark.slow
def test_a_dummy_in_a_folded_system_moves_no_ray(shared):
    """Mirrors, coordinate breaks, apertures and reversed light of a lens file."""
    system = schlieren(shared)
    lens, more = system.lens, design.with_dummy(system.lens, 0, 100.0)
    assert more.apertures.surfaces == lens.apertures.surfaces and lens.mirrors[0]
    np.testing.assert_array_equal(more.thickness[0], -100.0)
    assert [span[1] for span in more.elements.spans] == [more.count] * 4
    one, two = (
        trace_rays(design.open_apertures(each), system.scene, PUPIL) for each in (lens, more)
    )
    assert np.all(one.status == 0)
    kept = np.delete(np.arange(more.count + 1), 1)
    np.testing.assert_allclose(two.points[..., kept, :], one.points, rtol=0, atol=2e-12)  # of 3 m


@pytest.mark.parametrize(
    "name, surface, share",
    [("cooke_triplet", 0, 0.5), ("double_gauss", 2, 0.3), ("singlet", 1, 0.8)],
)
def test_an_element_split_by_power_keeps_its_power(name, surface, share):
    lens = load_lens(name)
    more = design.split(lens, surface, share, 0.2)
    before = power_by_matrices(lens, surface, surface + 1)
    assert power_by_matrices(more, surface, surface + 1) == pytest.approx(share * before, rel=1e-12)
    assert power_by_matrices(more, surface, surface + 3) == pytest.approx(before, rel=1e-12)
    assert float(more.thickness[surface + 1]) == pytest.approx(0.2, abs=1e-14)
    glass = lens.glasses[surface + 1]
    assert more.glasses[surface + 1 : surface + 4] == (glass, "air", glass)
    kept = np.delete(np.arange(more.count + 1), [surface + 1, surface + 2])
    for one, two in ((lens.curvature, more.curvature), (lens.vertices, more.vertices)):
        np.testing.assert_allclose(two[kept], one, rtol=0, atol=1e-12)
    focal = [first_order(each).effective_focal_length for each in (lens, more)]
    np.testing.assert_allclose(*focal, rtol=1e-12 if name == "singlet" else 2e-3)


def test_an_element_bends_at_constant_power():
    """Singlets, a cemented pair, and an asphere with terms of r^2."""
    for name, faces in (("cooke_triplet", (2, 3)), ("double_gauss", (2, 3, 4))):
        lens = load_lens(name)
        bent = design.bent(lens, faces, 0.01)
        change = np.asarray(bent.curvature - lens.curvature)
        np.testing.assert_allclose(change[list(faces[:-1])], 0.01, rtol=1e-12)
        assert change[faces[-1]] != 0 and np.count_nonzero(change) == len(faces)
        own = (power_by_matrices(each, faces[0], faces[-1]) for each in (lens, bent))
        np.testing.assert_allclose(*own, rtol=1e-12)
    singlet = load_lens("singlet")
    terms = jnp.zeros((4, 2)).at[1:3, 0].set(jnp.array([2e-3, -1e-3]))
    asphere = dataclasses.replace(singlet, coefficients=terms)
    found = [
        first_order(each).effective_focal_length
        for each in (asphere, design.bent(asphere, (1, 2), -0.02))
    ]
    np.testing.assert_allclose(*found, rtol=1e-12)
    back = design.bent(design.bent(singlet, (1, 2), 0.03), (1, 2), -0.03)
    np.testing.assert_allclose(back.curvature, singlet.curvature, atol=1e-15)


@pytest.mark.slow
def test_numbers_may_be_traced():
    """Derivatives of all edits in one program, compared with differences and with the calls outside
    of a trace."""
    lens = load_lens("cooke_triplet")
    edits = {
        "bent": (lambda x: design.bent(lens, (0, 1), x), 0.01),
        "share": (lambda x: design.split(lens, 0, x), 0.4),
        "gap": (lambda x: design.split(lens, 0, gap=x), 0.2),
        "plate": (lambda x: design.with_plate(lens, 3, GLASS, 1.0, x), 0.5),
        "dummy": (lambda x: design.with_dummy(lens, -1, x), 2.0),
        "cemented": (lambda x: design.cemented(lens, 1, x), 0.01),
        "joined": (lambda x: design.joined(lens, lens, x, "second"), 20.0),
    }

    def images(numbers):
        found = [edit(x) for (edit, _), x in zip(edits.values(), numbers)]
        return jnp.stack([first_order(one, 1e3).image_distance[0] for one in found]), found

    x, step = jnp.array([number for _, number in edits.values()]), 1e-4
    at = jax.jit(images)
    slopes, more = jax.jit(jax.jacfwd(images))(x)
    other = (at(x + step)[0] - at(x - step)[0]) / (2 * step)
    np.testing.assert_allclose(np.diagonal(slopes), other, rtol=1e-5, atol=1e-9)
    assert np.all(other[:6] != 0)
    backwards = jax.jit(jax.jacrev(lambda x: images(x)[0]))(x)
    np.testing.assert_allclose(backwards, slopes, rtol=1e-9, atol=1e-12)
    for (edit, number), own in zip(edits.values(), at(x)[1], strict=True):
        plain = edit(number)
        for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(own), strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-13, atol=1e-14)
    assert float(more[4].sensor[4]) == 1  # a dummy in front moves z


@pytest.mark.parametrize("surface, distance", [(5, 10.0), (3, 0.5), (-1, 5.0)])
def test_a_plate_leaves_paraxial_rays_behind_it_alone(surface, distance):
    lens = load_lens("cooke_triplet")
    more = design.with_plate(lens, surface, GLASS, distance, 1.5)
    n = float(more.index(WAVE)[surface + 2, 0])
    assert n == pytest.approx(1.5168, abs=1e-5)
    added = 1.5 * (1 - 1 / n) + (distance + 1.5 if surface < 0 else 0)
    assert float(more.sensor - lens.sensor) == pytest.approx(added, abs=1e-12)
    one, two = first_order(lens), first_order(more)
    np.testing.assert_allclose(two.effective_focal_length, one.effective_focal_length, rtol=1e-12)
    np.testing.assert_allclose(
        two.image_distance - more.sensor, one.image_distance - lens.sensor, atol=1e-11
    )
    np.testing.assert_array_equal(more.curvature[np.array([surface + 1, surface + 2])], 0)
    still = design.inserted(lens, surface, GLASS, -1, distance, 1.5)
    extra = distance + 1.5 if surface < 0 else 0
    np.testing.assert_allclose(still.sensor, lens.sensor + extra, atol=1e-12)
    if surface == 5:  # a ray of finite slope u: t (1 - cos u / sqrt(n^2 - sin^2 u)) tan u
        (rays, _), (plain, _) = traced(more, SCENE), traced(lens, SCENE)
        assert snell_errors(more, rays, SCENE.wavelengths) < 1e-12
        steps = plain[..., -1, :] - plain[..., -2, :]
        along = steps / np.linalg.norm(steps, axis=-1, keepdims=True)
        sine, cosine = np.hypot(*np.moveaxis(along[..., :2], -1, 0)), along[..., 2]
        index = np.asarray(more.index(SCENE.wavelengths))[7][:, None]
        far = 1.5 * (1 - cosine / np.sqrt(index**2 - sine**2))  # along the axis
        wanted = plain[..., -1, :2] + (added - far)[..., None] * (along[..., :2] / along[..., 2:])
        np.testing.assert_allclose(rays[..., -1, :2], wanted, rtol=0, atol=1e-11)


def test_a_camera_behind_its_attachment_is_the_bundled_one():
    whole, camera = load_lens("double_gauss_addon"), load_lens("double_gauss")
    pair = design.removed(design.with_stop(whole, 0), range(3, whole.count))
    pair = dataclasses.replace(pair, semi_diameter=whole.semi_diameter[np.array([0, 1, 2, -1])])
    found = design.joined(pair, dataclasses.replace(camera, sensor=whole.sensor - 12), 2, "second")
    assert (found.stop, found.glasses, found.forms) == (whole.stop, whole.glasses, whole.forms)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    found.check()
    assert design.joined(pair, camera, 2.0).stop == 0


def test_two_lenses_have_the_focal_length_of_textbooks():
    """From their powers and the distance between principal planes; rays obey Snell's law."""
    front, back = load_lens("cooke_triplet"), drt_jax.flipped(load_lens("double_gauss"))
    both = design.joined(front, back, 60.0)
    one, two, found = (first_order(each) for each in (front, back, both))
    # From the rear principal plane of the front lens to the front one of the back lens.
    space = 60.0 + one.effective_focal_length - one.back_focal_distance
    space = space + two.effective_focal_length + two.front_focal_distance
    powers = 1 / one.effective_focal_length, 1 / two.effective_focal_length
    whole = powers[0] + powers[1] - space * powers[0] * powers[1]
    np.testing.assert_allclose(1 / found.effective_focal_length, whole, rtol=1e-10)
    scene = Scene.degrees([[0, 0], [1, 2]], np.inf, (0.6, 0.48))
    assert snell_errors(both, traced(both, scene)[0], scene.wavelengths) < 1e-12


def test_what_two_lenses_carry_is_joined(shared):
    """Coordinate breaks of the first lens move the second; apertures and tilts stay at their
    surfaces."""
    first, camera = schlieren(shared).lens, load_lens("cooke_triplet")
    tilted = dataclasses.replace(
        camera,
        tilt=jnp.zeros((7, 3)).at[2, 0].set(0.01),
        apertures=drt_jax.lens.aperture.Apertures(
            jnp.array([[3.0, 2.0]]), surfaces=(2,), kinds=("rectangle",), blocks=(False,)
        ),
    )
    found = design.joined(first, tilted, 1e3)
    found.check()
    assert found.apertures.surfaces == (*first.apertures.surfaces, first.count + 2)
    assert found.apertures.kinds[-1] == "rectangle" and found.count == first.count + 6
    ends = [span for span in found.elements.spans if span[1] == found.count]
    assert len(ends) == 3 and len(found.elements.spans) == 3  # the break of the sensor alone went
    # The second lens is a rigid body in the axes of the first one's break.
    z, across, turned = found.places
    place = np.stack([np.asarray(across)[:, 0], np.asarray(across)[:, 1], np.asarray(z)], axis=1)
    start = first.count
    along = np.asarray(turned)[start][:, 2]
    apart = np.asarray(camera.vertices)
    np.testing.assert_allclose(
        place[start:] - place[start], apart[:, None] * along[None], atol=1e-9
    )
    own = np.asarray(turned)[start].T @ np.asarray(turned)[start + 2]
    np.testing.assert_allclose(own[2, 1], np.sin(0.01), atol=1e-12)
    alone = first.places
    end = np.array([*np.asarray(alone[1])[start - 1], np.asarray(alone[0])[start - 1]])
    np.testing.assert_allclose(place[start - 1], end, atol=1e-9)


def test_two_elements_are_cemented():
    lens = load_lens("cooke_triplet")
    found = design.cemented(lens, 1, 0.01)
    assert found.glasses == ("air", "SK16", "F2", "air", "SK16", "air")
    assert found.stop == lens.stop - 1 and float(found.curvature[1]) == 0.01
    gap = float(lens.thickness[1])
    kept = np.array([0, 1, 3, 4, 5, 6])
    wanted = np.asarray(lens.vertices)[kept] - gap * (kept > 1)
    np.testing.assert_allclose(found.vertices, wanted, atol=1e-12)
    assert snell_errors(found, traced(found, SCENE)[0], SCENE.wavelengths) < 1e-12
    mean = design.cemented(lens, 1).curvature[1]
    np.testing.assert_allclose(mean, jnp.mean(lens.curvature[1:3]), rtol=1e-14)


def mirrored():
    """The triplet whose last surface is a mirror."""
    return dataclasses.replace(load_lens("cooke_triplet"), mirrors=(False,) * 5 + (True,))


def in_water(lens):
    names = ("water", *lens.glasses[1:])
    return dataclasses.replace(lens, labels=drt_jax.lens.lens.Labels("", names))


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda lens: design.with_dummy(lens, 6), "surface: expected one from 0 to 5, got 6"),
        (lambda lens: design.with_dummy(lens, 0, "a"), "distance: expected real numbers"),
        (lambda lens: design.split(lens, 0, 1.2), "share: expected a number between 0 and 1"),
        (lambda lens: design.split(lens, 1), "glass: air is behind surface 1 already"),
        (lambda lens: design.split(lens, 0, gap=9), "expected two numbers above 0"),
        (lambda lens: design.bent(lens, (0, 2), 0.1), "surfaces: expected neighbours of 0 to 5"),
        (lambda lens: design.bent(lens, (0,), 0.1), "surfaces: expected neighbours of 0 to 5"),
        (lambda lens: design.cemented(lens, 0), "surface: air, SK16, air cannot be cemented at 0"),
        (lambda lens: design.cemented(lens, 5), "SK16, air, the sensor cannot be cemented at 5"),
        (lambda lens: design.joined(lens, lens, -1), "gap: expected mm above 0, got -1"),
        (lambda lens: design.joined(lens, lens, 1, "both"), "stop: expected one of first, second"),
        (lambda lens: design.joined(mirrored(), lens, 1), "first: light leaves it backwards"),
        (
            lambda lens: design.joined(lens, in_water(lens), 1),
            "second: air ends first, water begin",
        ),
    ],
)
def test_what_cannot_be_done_is_refused(change, told):
    with pytest.raises(ValueError, match=told):
        change(load_lens("cooke_triplet"))
