"""Transfer functions, Strehl ratios and Zernike coefficients, compared with closed forms and other
programs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.special import fresnel

import drt_jax
from drt_jax import Clipped, Gauss, Scene, Status, load_lens
from drt_jax.image import transfer, zernike
from drt_jax.image.beam import BeamRule, beam_of
from drt_jax.lens.forms import fringe_terms
from drt_jax.lens.scene import checked_scene
from drt_jax.rays.trace import trace_bundle

from ..known import check_slopes, freed

COOKE = freed(load_lens("cooke_triplet"))
WAVES = (0.6, 0.53, 0.48)
RULE = Gauss(8, "bilateral")
# A paraboloid of f/50: a perfect image, whose pupil is uniform in direction cosines to 1e-4.
MIRROR = {
    "surfaces": [
        {"curvature": 0, "thickness": 100.0, "semi_diameter": 1.0, "stop": True},
        {"radius": -200, "conic": -1, "mirror": True, "thickness": -100.0},
    ]
}
APERTURE, WAVE = 1 / np.hypot(1, 100 - 1 / 400), 0.5
LIMIT = 2 * APERTURE / (WAVE * 1e-3)
# P10: the circle at .1, .25, .5, .75, .9 of the limit; the annulus of 0.612 at the same.
PARTS = np.array([0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0, 1.1])
CIRCLE = [0.8728885715695383, 0.6850376424742927, 0.3910022189557706, 0.14429361281438743]
CIRCLE = [1, *CIRCLE, 0.037386073468498655, 0, 0]
ANNULUS = [0.672741897596168, 0.2734419333643833, 0.15954292807930207, 0.18696185734888282]
ANNULUS = [*ANNULUS, 0.05977410636159643]
# P01, and the Zernike coefficients that OpticStudio 25.1.1 prints.
P01 = {
    "surfaces": [
        {"curvature": 0, "thickness": 0.0, "semi_diameter": 1.0, "stop": True},
        {"radius": 20.0, "index": 1.5, "thickness": 1.0},
        {"radius": -20.0, "thickness": 19.792},
    ]
}
PRINTED = {1: -0.01473686, 4: 0.00031809, 11: 0.00684048, 22: 3.01e-06}


def perfect(focus):
    """Results of the mirror, at all `PARTS`, in one program."""
    lines = PARTS * LIMIT
    return drt_jax.transfer(
        load_lens(MIRROR),
        Scene.radians([0.0], np.inf, WAVE),
        lines,
        focus=focus,
        sampling=drt_jax.Sampling.of("waves", RULE, 128),
    )


@pytest.mark.slow
def test_the_transfer_function_of_a_perfect_circle():
    found = perfect(0.0)
    for way in range(2):
        np.testing.assert_allclose(found.mtf[0, way], CIRCLE, rtol=0, atol=2e-5)
    np.testing.assert_allclose(found.limit, found.mtf, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_a_grid_too_coarse_for_the_blur_shows_no_contrast():
    """For a defocus of 85 waves a cell contains a whole period of the wave at a quarter of the
    limit: all samples would be equal, with a contrast of 0.68."""
    edges = np.arange(81.0, 89.0, 0.5)
    focus = edges * WAVE * 1e-3 / (1 - np.sqrt(1 - APERTURE**2))
    found = np.array([perfect(float(step)).mtf[0] for step in focus])
    assert np.max(found[..., 2]) < 0.01


@pytest.mark.slow
def test_the_transfer_function_of_an_annulus():
    """P10, O'Neill's formula for an obscuration of 0.612 of the radius; the table was made by a
    grid, to 1.5e-4."""
    stop, mirror = MIRROR["surfaces"]
    lens = load_lens({"surfaces": [stop | {"obscuration": {"circle": 0.612}}, mirror]})
    rule = Clipped(6, "bilateral", crossing=False)
    scene = lens, Scene.radians([0.0], np.inf, WAVE), PARTS[1:6] * LIMIT
    found = drt_jax.transfer(*scene, sampling=drt_jax.Sampling.of("waves", rule, 128, 6))
    for way in range(2):
        np.testing.assert_allclose(found.mtf[0, way], ANNULUS, rtol=0, atol=2e-4)


def aspheric(coefficient, radius):
    """The mirror with a sag of `coefficient` r^4 and a stop of a radius: one program for all."""
    stop, mirror = MIRROR["surfaces"]
    mirror = mirror | {"coefficients": {4: coefficient}}
    return load_lens({"surfaces": [stop | {"semi_diameter": radius}, mirror]})


@pytest.mark.slow
def test_strehl_with_spherical_aberration():
    """W r^4 waves in the paraxial focus, and with -W r^2 of defocus: by Fresnel's integrals
    (Mahajan, Optical Imaging and Aberrations II (2011)); for small W by exp(-(2 pi sigma)^2)."""
    # Ten times larger: many Fresnel zones as seen from the mirror, which deforms the wave.
    radius, larger = 6.0, 10.0
    square = 1 / (1 + (100 / radius - radius / 400) ** 2)
    for waves in (0.1, 0.5, 1.0, 2.0):
        lens = aspheric(waves * WAVE * 1e-3 / (2 * radius**4) / larger, radius)
        lens = drt_jax.scaled(lens, larger)
        focus = waves * WAVE * 1e-3 / (1 - np.sqrt(1 - square))
        for step, width, sigma in ((0.0, 2, 2 / np.sqrt(45)), (-focus, 1, 1 / np.sqrt(180))):
            moved = dataclasses.replace(lens, sensor=lens.sensor + step)
            found = float(drt_jax.strehl(moved, Scene.radians([0.0], np.inf, WAVE), RULE)[0, 0])
            wanted = sum(a**2 for a in fresnel(width * np.sqrt(waves))) / (width**2 * waves)
            # Light is not quite uniform over the directions of a deformed paraboloid.
            assert abs(found - wanted) < (2e-4 if waves == 0.1 else 4e-3)
            if waves == 0.1:
                assert abs(found - np.exp(-((2 * np.pi * waves * sigma) ** 2))) < 2e-4


@pytest.mark.slow
def test_defocus_and_strehl():
    """|OTF| of a defocused circle by Hopkins (Proc. R. Soc. A 231, 91 (1955)), here summed over the
    overlap of two pupils; the Strehl ratio is sinc^2 of the waves at the edge."""
    lens = aspheric(0.0, 1.0)
    side = (np.arange(2000) + 0.5) / 1000 - 1
    x, y = np.meshgrid(side, side)
    edges, parts = np.array([0.25, 0.5, 1.0]), PARTS[[1, 2, 4]]
    steps = edges * WAVE * 1e-3 / (1 - np.sqrt(1 - APERTURE**2))
    given = lens, Scene.radians([0.0], np.inf, WAVE), parts * LIMIT
    through = drt_jax.transfer(
        *given, focus=steps, sampling=drt_jax.Sampling.of("waves", RULE, 128)
    ).mtf
    assert through.shape == (1, 3, 2, 3)
    for k, (edge, focus) in enumerate(zip(edges, steps)):
        moved = dataclasses.replace(lens, sensor=lens.sensor + focus)
        ratio = drt_jax.strehl(moved, Scene.radians([0.0], np.inf, WAVE), RULE)
        np.testing.assert_allclose(ratio, np.sinc(edge) ** 2, rtol=0, atol=2e-4)
        for part, ours in zip(parts, through[0, k, 0]):
            both = (np.hypot(x, y + part) < 1) & (np.hypot(x, y - part) < 1)
            waves = np.cos(2 * np.pi * edge * 4 * y[both] * part)
            wanted = abs(np.sum(waves)) / np.sum(np.hypot(x, y) < 1)
            np.testing.assert_allclose(ours, wanted, rtol=0, atol=5e-4)


def traced(field, wavelength):
    """Hits (Q, 2) mm of many rays, and weights (Q,)."""
    points, weights = drt_jax.pupil.disc(30, 60)
    rays = drt_jax.trace_rays(COOKE, Scene.point(field, np.inf, wavelength), points)
    return np.asarray(rays.points)[0, :, -1, :2], weights


@pytest.mark.slow
def test_the_limit_of_short_wavelengths_is_that_of_rays():
    """The transfer function of rays is the mean over many traced ones."""
    fields, frequencies = [0.0, 0.2], np.linspace(0, 20, 5)
    rays = drt_jax.transfer(
        COOKE,
        Scene.radians(fields, np.inf, 0.55),
        frequencies,
        "rays",
        sampling=drt_jax.Sampling.of("rays", RULE, 96),
    )
    for k, field in enumerate(fields):
        hits, weights = traced(field, 0.55)
        hits = hits - weights @ hits
        for way, place in enumerate((hits[:, 1], hits[:, 0])):
            wanted = np.exp(-2j * np.pi * np.outer(frequencies, place)) @ weights
            np.testing.assert_allclose(rays.otf[k, way], wanted, rtol=0, atol=1e-3)
    np.testing.assert_allclose(rays.limit, 1)


@pytest.mark.slow
def test_colours_add_up_about_one_point():
    """Lateral colour reduces contrast: the sum over the wavelengths has phases from the positions
    of their images."""
    frequencies = np.linspace(0, 100, 6)

    def otf(weights):
        scene = Scene.point(0.2, np.inf, WAVES, wavelength_weights=weights)
        return drt_jax.transfer(COOKE, scene, frequencies, sampling=RULE).otf[0]

    share = np.array([1.0, 2.0, 1.5]) / 4.5
    spots = [(weights @ hits)[1] for hits, weights in (traced(0.2, w) for w in WAVES)]
    wanted = 0
    for part, alone, spot in zip(share, np.eye(3), spots):
        turn = np.exp(-2j * np.pi * frequencies * (spot - share @ np.array(spots)))
        wanted += part * np.asarray(otf(alone)) * turn
    np.testing.assert_allclose(otf(4.5 * share), wanted, rtol=0, atol=2e-6)


@pytest.mark.slow
def test_the_zernike_coefficients_that_opticstudio_prints():
    lens = load_lens(P01)
    found = np.asarray(drt_jax.zernike_standard(lens, Scene.radians([0.0], np.inf, 0.543)))[0, 0]
    wanted = np.zeros(37)
    for term, value in PRINTED.items():
        wanted[term - 1] = value
    np.testing.assert_allclose(found, wanted, rtol=0, atol=5.1e-9)
    rms = np.sqrt(np.sum(found[1:] ** 2))
    np.testing.assert_allclose(rms, 0.00684787, rtol=0, atol=5.1e-9)


@jax.jit
def slopes(lens, field):
    """All analyses of a clipped pupil from one bundle: ((merit, results), gradient of the merit by
    the lens)."""
    pattern = drt_jax.pupil.disc(9, 18)
    points = tuple(jnp.asarray(np.concatenate([np.zeros((1, 2)), pattern[0]]).T))
    weights = np.random.default_rng(0).normal(size=18)

    def total(lens):
        scene = checked_scene(lens, Scene.point(field, np.inf, WAVES[:2]))
        bundle = trace_bundle(lens, scene, points)
        passes = jnp.where(bundle.status == Status.OK, np.append(0, pattern[1])[None], 0)
        rule = BeamRule(drt_jax.Clipped(5, "none"), 8)
        beam = beam_of(lens, scene, rule, points, passes, bundle)
        view = lens, Scene.radians(field[None], np.inf, WAVES[:2])
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(transfer, "beams_of", lambda *_: jax.tree.map(lambda a: a[None], beam))
            patch.setattr(zernike, "disc", lambda *_: pattern)
            patch.setattr(zernike, "trace_bundle", lambda *_: bundle)
            for module, name in (
                (transfer, "_transfer"),
                (transfer, "_strehl"),
                (zernike, "_least_squares"),
            ):
                patch.setattr(module, name, getattr(module, name).__wrapped__)
            models = {
                kind: drt_jax.transfer(
                    *view,
                    jnp.array([0.0, 20.0]),
                    kind,
                    sampling=drt_jax.Sampling.of(kind, RULE, 48, 8),
                )
                for kind in ("waves", "rays")
            }
            ratio = drt_jax.strehl(*view, sampling=drt_jax.Sampling.of("waves", RULE, 48, 8))
            terms = drt_jax.zernike_standard(*view), drt_jax.zernike_fringe(*view)
        parts = [models[kind].mtf[0, :, 1] for kind in models]
        parts = jnp.concatenate([*parts, ratio[0], terms[0][0, 0, :12]])
        return jnp.sum(weights * jnp.where(jnp.isfinite(parts), parts, 0)), (models, ratio, terms)

    return jax.value_and_grad(total, has_aux=True)(lens)


@pytest.mark.slow
def test_fringe_coefficients():
    """For the same wavefront, terms of n, m are sqrt(n + 1) or sqrt(2 n + 2) times those of Noll;
    the order is that of listings."""
    terms = fringe_terms()
    order = [(0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0), (3, 3)]
    assert terms[:10] == order and terms[15] == (6, 0) and terms[24] == (8, 0)
    assert len(terms) == 37 and terms[35:] == [(10, 0), (12, 0)]
    (_, (*_, found)), _ = slopes(COOKE, jnp.array([0.0, 0.2]))
    standard, fringe = (np.asarray(part)[0, 0] for part in found)
    np.testing.assert_allclose(fringe[3], np.sqrt(3) * standard[3], rtol=1e-6)
    np.testing.assert_allclose(fringe[8], np.sqrt(5) * standard[10], rtol=1e-6)
    np.testing.assert_allclose(fringe[7], np.sqrt(8) * standard[6], rtol=1e-6)  # coma along y


@pytest.mark.slow
def test_no_light_no_contrast():
    (_, found), slope = slopes(COOKE, jnp.array([0.0, 1.55]))
    models, ratio, terms = found
    assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves((slope, found)))
    assert all(np.all(one.otf == 0) for one in models.values()) and np.all(ratio == 0)
    assert np.all(models["waves"].limit == 0) and np.all(np.isinf(terms[0]))
    (_, (models, *_)), _ = slopes(COOKE, jnp.array([0.0, 0.1]))
    for one in models.values():
        np.testing.assert_allclose(one.mtf[..., 0], 1, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_by_lens_numbers():
    """Reverse mode compared with central differences, in a clipped pupil."""
    lens = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(6.5))
    field = jnp.array([0.0, 0.25])
    check_slopes(
        lambda lens: slopes(lens, field),
        lens,
        {"curvature": 1e-8, "thickness": 1e-6, "semi_diameter": 2e-5},
        2e-4,
    )


def counted(field, front, cells=500, shifts=(18, 43, 86)):
    """MTF (2, N) of the Cooke triplet, whose first surface has the semi-diameter `front` mm, and
    frequencies: sums over cells of the direction cosines from the sphere of the exit pupil,
    interpolated between 20,000 rays, without polynomials."""
    semi = jnp.full_like(COOKE.semi_diameter, jnp.inf)
    semi = semi.at[COOKE.stop].set(COOKE.semi_diameter[COOKE.stop])
    side = np.linspace(-1.04, 1.04, 161)
    points = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    points = points[np.hypot(*points.T) < 1.04]
    lens = dataclasses.replace(COOKE, semi_diameter=semi)
    rays = drt_jax.trace_rays(lens, Scene.point(field, np.inf, 0.55), points)
    assert not np.any(rays.status)
    hits, along = np.asarray(rays.points)[0], np.asarray(rays.directions)[0, :, -1]
    # Back along the rays to the sphere about the centroid of the spot.
    away = float(
        lens.sensor
        - lens.vertices[-2]
        - drt_jax.first_order(lens, jnp.inf, 0.55).exit_pupil.position[0]
    )
    radius, spot = away / along[:, 2].mean(), hits[:, -1] - hits[:, -1].mean(axis=0)
    ahead = np.sum(along * spot, axis=1)
    back = ahead + np.sqrt(ahead**2 - np.sum(spot**2, axis=1) + radius**2)
    along = ((back[:, None] * along - spot) / radius)[:, :2]
    path = np.asarray(rays.path)[0] - back
    step = np.ptp(along[:, 1]) / cells
    grid = np.meshgrid(*(np.arange(a.min(), a.max(), step) for a in along.T))
    known = np.column_stack([points, path - path.mean(), hits[:, 0, :2]])
    x, y, waves, *first = np.moveaxis(CloughTocher2DInterpolator(along, known)(*grid), -1, 0)
    (xy, xx), (yy, yx) = np.gradient(x, step), np.gradient(y, step)
    light = np.where((np.hypot(x, y) < 1) & (np.hypot(*first) < front), abs(xx * yy - xy * yx), 0)
    assert 0.8 < np.sum(light) * step**2 / np.pi < 0.9
    pupil = np.where(light > 0, np.sqrt(light) * np.exp(2j * np.pi * waves / 0.55e-3), 0)
    both = [[abs(np.vdot(a[m:], a[:-m])) / np.sum(light) for m in shifts] for a in (pupil, pupil.T)]
    return np.array(both), np.array(shifts) * step / 0.55e-3


@pytest.mark.slow
def test_the_transfer_function_of_a_clipped_pupil():
    """The front passes 86 % of the light; compared with a count of cells."""
    wanted, lines = counted(0.25, 6.5)
    lens = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(6.5))
    found = drt_jax.transfer(
        lens,
        Scene.radians([0.25], np.inf, 0.55),
        lines,
        sampling=drt_jax.Sampling.of("waves", Clipped(8, "bilateral"), 256),
    )
    np.testing.assert_allclose(found.mtf[0], wanted, rtol=0, atol=1e-4)


@pytest.mark.slow
def test_strehl_does_not_depend_on_the_direction_of_a_field():
    """The field along y and along the diagonal of x and y, where the clipped pupil is a slanted
    oval, so that tilts along x and y are correlated."""
    lens = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(4.0))
    fields = 0.12 * np.array([[0.0, 1.0], [0.5**0.5, 0.5**0.5]])
    along, diagonal = drt_jax.strehl(
        lens,
        Scene.radians(fields, np.inf, [0.55]),
        sampling=drt_jax.Sampling.of("waves", Clipped(6, "none"), 64, 8),
    )[:, 0]
    assert 0.02 < along < 0.98
    np.testing.assert_allclose(diagonal, along, rtol=0, atol=3e-3)
