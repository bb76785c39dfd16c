import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Gauss, Scene, load_lens
from drt_jax.lens.glass import Dispersion, Glass, model_glass, refractive_index
from drt_jax.lens.glasses import _table, find_glass, glass_map_distance

# n_d of the catalogue pages and, for CODE V's listing of its Double Gauss sample, the indices
# that program prints at 656.3, 587.6 and 486.1 nm (6 decimals).
N_D = {"N-BK7": 1.5168, "SF10": 1.72825, "F2": 1.62004, "SK16": 1.62041, "N-SF11": 1.78472}
CODE_V = {
    "N-SSK2": (1.618769, 1.622292, 1.630455),
    "N-SK2": (1.604134, 1.607379, 1.614860),
    "F5": (1.598744, 1.603417, 1.614617),
    "N-SK16": (1.617271, 1.620408, 1.627559),
}


def index(name, *wavelengths):
    dispersion = Dispersion.of([find_glass(name)])
    return np.asarray(refractive_index(dispersion, jnp.array(wavelengths))[0])


@pytest.mark.parametrize("name", N_D)
def test_catalogue_index_at_the_d_line(name):
    np.testing.assert_allclose(index(name, 0.5875618), N_D[name], atol=6e-6)


@pytest.mark.parametrize("name", CODE_V)
def test_indices_that_code_v_prints(name):
    np.testing.assert_allclose(index(name, 0.6563, 0.5876, 0.4861), CODE_V[name], atol=6e-7)


# nd and vd: of the makers and handbooks, of the plastics in the catalogues of design programs; of
# Optorez, as measured by Sultanova, Kasarova and Nikolov (2009), to 0.001 and 1.
PUBLISHED = {
    "silica": (1.45846, 67.82),
    "CaF2": (1.43385, 95.0),
    "PMMA": (1.49176, 57.44),
    "polycarbonate": (1.58547, 29.91),
    "polystyrene": (1.59048, 30.87),
    "SAN": (1.56744, 34.81),
    "COC": (1.53373, 56.23),
    "E48R": (1.53117, 56.0),
    "480R": (1.52530, 55.9),
    "330R": (1.50942, 56.0),
    "Optorez-1330": (1.509, 52.0),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_plastics_silica_and_fluorite(name):
    d, f, c = index(name, *LINES[:3])
    loose = name == "Optorez-1330"
    np.testing.assert_allclose(d, PUBLISHED[name][0], atol=1e-3 if loose else 3e-5)
    np.testing.assert_allclose((d - 1) / (f - c), PUBLISHED[name][1], atol=0.7 if loose else 0.15)
    low, high = find_glass(name).range
    n = index(name, *np.linspace(low, high, 101))
    assert np.all(np.diff(n) < 0) and np.all(n > 1)


def test_water_of_daimon_and_masumura():
    """Four Sellmeier terms; relative to vacuum, n_D = 1.33335 at 0.5893 um and 20 C, n_d = 1.3334
    and the range 0.182 to 1.129 um as in refractiveindex.info."""
    np.testing.assert_allclose(index("water", 0.5893), 1.33335, atol=5e-6)
    np.testing.assert_allclose(index("water", 0.5875618), 1.3334, atol=5e-5)
    assert find_glass("water").range == (0.182, 1.129)


def test_more_terms_of_one_medium_change_no_other():
    """In a lens with water, N-BK7 has padded terms and the same index to the last digit."""
    media = Dispersion.of([find_glass(name) for name in ("water", "N-BK7", "SK16", "air")])
    assert media.strength.shape == (4, 4)
    n = refractive_index(media, jnp.array([0.45, 0.65]))
    alone = [index(name, 0.45, 0.65) for name in ("water", "N-BK7", "SK16", "air")]
    np.testing.assert_allclose(n, alone, rtol=1e-15)


def test_air_and_constant_index():
    media = Dispersion.of([find_glass("air"), Glass("n", schott=(2.25, 0, 0, 0, 0, 0))])
    n = refractive_index(media, jnp.array([0.4, 0.7]))
    np.testing.assert_array_equal(n, [[1, 1], [1.5, 1.5]])


def test_old_and_new_glass_types_are_not_mixed_up():
    assert abs(index("SK16", 0.48) - index("N-SK16", 0.48)) > 1e-6


@pytest.mark.parametrize("name, near", [("N-BK8", "N-BK7"), ("nsk16", "N-SK16"), ("sk16", "SK16")])
def test_unknown_glass_lists_near_names(name, near):
    with pytest.raises(ValueError, match=f"unknown glass '{name}'.*{near}"):
        find_glass(name)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_range_of_the_glasses_is_known_inside_a_trace(dtype):
    """SK16 has 0.4 to 0.7 um, both ends included in float32 and float64; F2 starts at 0.32 um."""
    media = Dispersion.of([find_glass(name) for name in ("air", "F2", "SK16")])
    assert media.range == (0.4, 0.7)
    w = jnp.array([0.1, 0.4, 0.55, 0.7, 0.71, jnp.nan, -0.5], dtype)
    known = jax.jit(Dispersion.knows)(media, w)
    np.testing.assert_array_equal(known, [False, True, True, True, False, False, False])
    triplet = load_lens("cooke_triplet")
    triplet.check_wavelengths(w[1:4])
    for wrong in (*w[:1], *w[4:]):
        with pytest.raises(ValueError, match="um is outside the range of"):
            triplet.check_wavelengths(wrong)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_without_a_glass_any_wavelength_but_zero_will_do(dtype):
    media = Dispersion.of([Glass("n", schott=(2.25, 0, 0, 0, 0, 0))])
    low, high = media.range
    w = jnp.array([0.0, low, 10.6, high], dtype)
    np.testing.assert_array_equal(media.knows(w), [False, True, True, True])
    n = refractive_index(jax.tree.map(lambda a: a.astype(dtype), media), w[1:])
    np.testing.assert_array_equal(n, [[1.5] * 3])


LINES = 0.5875618, 0.4861327, 0.6562725, 0.4358343  # d, F, C, g
BETWEEN = np.linspace(0.45, 0.65, 41)
# Glasses of every family, and the largest error of n in the documentation.
FAMILIES = {
    **dict.fromkeys(("N-BAF4", "N-SSK5", "LLF1", "N-KF9"), 3e-5),
    **dict.fromkeys(("N-BK7", "N-BAK4", "N-K5", "N-SK16", "F2", "N-PSK53A", "N-BASF2"), 7e-5),
    **dict.fromkeys(("N-LAK9", "N-LAF2", "N-LASF31A"), 1.4e-4),
    **dict.fromkeys(("N-PK51", "N-FK51A", "N-KZFS4"), 2.1e-4),
    **dict.fromkeys(("N-SF11", "SF10", "P-SF68"), 1.05e-3),
}


@pytest.mark.parametrize("name", FAMILIES)
def test_a_model_glass_beside_the_catalogue(name):
    """It has exactly the same nd and vd; n between 0.45 and 0.65 um agrees within the documented
    error."""
    d, f, c, _ = index(name, *LINES)
    model = Dispersion.of([model_glass(float(d), float((d - 1) / (f - c))), find_glass(name)])
    at = np.asarray(refractive_index(model, jnp.array(LINES)))
    np.testing.assert_allclose(at[0, 0], d, rtol=1e-14)
    np.testing.assert_allclose(at[0, 1] - at[0, 2], f - c, rtol=1e-11)
    ours, wanted = np.asarray(refractive_index(model, jnp.array(BETWEEN)))
    np.testing.assert_array_equal(wanted, index(name, *BETWEEN))  # beside a model, nothing changes
    assert 1e-7 < np.max(np.abs(ours - wanted)) < FAMILIES[name]


def test_derivatives_of_a_model_glass():
    """By nd and vd, compared with differences; and the partial dispersion of the normal line."""
    model = Dispersion.of([model_glass(1.83481, 42.7)])
    _, f, c, g = np.asarray(refractive_index(model, jnp.array(LINES)))[0]
    np.testing.assert_allclose((g - f) / (f - c), 0.6438 - 0.001682 * 42.7, rtol=1e-11)

    def n(values):
        return refractive_index(dataclasses.replace(model, model=values[None]), jnp.array([0.48]))

    at = model.model[0]
    for step, slope in zip(1e-4 * np.diag(at), np.asarray(jax.jacfwd(n)(at)).ravel()):
        change = (n(at + step) - n(at - step)) / (2 * step.sum())
        np.testing.assert_allclose(slope, change.ravel()[0], rtol=1e-7)


@pytest.mark.parametrize("nd, vd", [(1.0, 50.0), (4.1, 50.0), (1.5, 5.0), (1.5, 200.0)])
def test_impossible_model_glasses(nd, vd):
    with pytest.raises(ValueError, match="expected 1 < nd"):
        model_glass(nd, vd)


def solids():
    """nd and vd of all solids of the catalogue, by `index`."""
    plain = [name for name, entries in _table().items() if entries[0].plain]
    names = [name for name in plain if name not in ("air", "water")]
    lines = np.array([index(name, *LINES[:3]) for name in names])
    return np.stack([lines[:, 0], (lines[:, 0] - 1) / (lines[:, 1] - lines[:, 2])], axis=1)


def test_distance_to_the_glass_map():
    """The distance from all lines through two glasses that have every glass on one side: 0 or less
    for all glasses, above 0 in regions without glasses."""
    glasses = solids()
    scaled = np.unique(glasses * [1, 0.01], axis=0)
    ways = scaled[None] - scaled[:, None]
    lengths = np.linalg.norm(ways, axis=-1, keepdims=True)
    normals = np.stack([ways[..., 1], -ways[..., 0]], -1) / np.where(
        lengths > 1e-9, lengths, np.nan
    )
    away = np.sum(normals * scaled[:, None], axis=-1)
    hull = np.concatenate([normals, -away[..., None]], axis=-1)
    hull = hull[np.all(normals @ scaled.T <= away[..., None] + 1e-13, axis=-1)]
    corners = np.array([[1.85, 70.0], [1.45, 40.0], [1.6, 50.0], [2.1, 25.0]])
    points = np.concatenate([glasses, corners])
    wanted = np.max((points * [1, 0.01]) @ hull[:, :2].T + hull[:, 2], axis=1)
    found = glass_map_distance(jnp.asarray(points))
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert np.max(found[: len(glasses)]) < 1e-12 and np.sum(np.abs(found) < 1e-12) > 5
    assert found[-4] > 0.1 and found[-3] > 0.05 and found[-2] < -0.05 and found[-1] > 0.05


@pytest.mark.slow
def test_catalogue_glasses_made_model_glasses(tmp_path):
    """nd and nF - nC do not change, so that focal lengths at d and F - C stay; spots change by the
    error of a model glass; nd and vd are leaves."""
    lens = drt_jax.load_lens("double_gauss")
    model = drt_jax.with_model_glass(lens)
    before, after = (np.asarray(each.index(LINES[:3])) for each in (lens, model))
    np.testing.assert_allclose(after[:, 0], before[:, 0], rtol=1e-14)
    np.testing.assert_allclose(after[:, 1] - after[:, 2], before[:, 1] - before[:, 2], atol=1e-14)
    ours, own = (float(drt_jax.focal_length(each, LINES[0])[0]) for each in (model, lens))
    assert abs(ours / own - 1) < 1e-12 and model.active == lens.active
    scene, rule = Scene.point(0.0, np.inf, (0.48, 0.6)), Gauss(6, "rotational")
    spots = [
        np.trace(drt_jax.psf_moments(each, scene, sampling=rule).covariance, axis1=1, axis2=2)
        for each in (model, lens)
    ]
    np.testing.assert_allclose(*spots, rtol=0.1)

    @jax.jit
    def power(nd):
        moved = dataclasses.replace(model.dispersion, model=model.dispersion.model.at[1, 0].set(nd))
        moved = dataclasses.replace(model, dispersion=moved)
        return 1 / drt_jax.first_order(moved, jnp.inf, jnp.array([LINES[0]])).focal_length[0]

    assert abs(float(jax.grad(power)(before[1, 0]))) > 1e-3
    drt_jax.save_lens(model, tmp_path / "model.yaml")
    again = drt_jax.load_lens(tmp_path / "model.yaml")
    np.testing.assert_array_equal(again.index(LINES[:3]), model.index(LINES[:3]))
    jitted = jax.jit(drt_jax.with_model_glass)(lens)
    np.testing.assert_allclose(jitted.index(LINES), model.index(LINES), rtol=1e-14)


def test_a_lens_of_arrays_of_numpy_exchanges_glasses():
    """A lens with a model glass and a real one; and a real one in place of the model glass."""
    lens = jax.tree.map(np.asarray, drt_jax.load_lens("double_gauss"))
    first = next(i for i, glass in enumerate(lens.glasses[1:]) if glass != "air")
    model = jax.tree.map(np.asarray, drt_jax.with_model_glass(lens, [first]))
    again = drt_jax.with_glass(model, find_glass(lens.glasses[first + 1]), [first])
    np.testing.assert_allclose(again.index(LINES), lens.index(LINES), rtol=1e-14)
    assert again.glasses == lens.glasses != model.glasses


def test_some_glasses_made_model_glasses(tmp_path):
    """For a stop inside a glass the media on both sides; the others do not change."""
    lens = drt_jax.load_lens("cooke_triplet")
    one = drt_jax.with_model_glass(lens, (2,))
    assert [name.startswith("model ") for name in one.glasses] == [i == 3 for i in range(7)]
    ours, own = (np.asarray(each.index(0.6))[[1, 5]] for each in (one, lens))
    np.testing.assert_array_equal(ours, own)
    with pytest.raises(ValueError, match="no glass begins behind surface 1; there are 0, 2, 4"):
        drt_jax.with_model_glass(lens, (1,))
    path = tmp_path / "index.yaml"
    path.write_text(
        "surfaces: [{radius: 9, thickness: 90, index: 1.5, semi_diameter: 1, stop: true}]"
    )
    with pytest.raises(ValueError, match="index 1.5 has no vd of 10 to 120"):
        drt_jax.with_model_glass(drt_jax.load_lens(path))
