"""float32, JAX's default: right, or told."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax.image import rounding
from drt_jax.image.beam import beam_rule
from drt_jax.lens.scene import scene_of

REMEDY = r'in float32 path differences may be wrong by .* waves RMS.*"jax_enable_x64", True'
GREEN = (0.55,)


def single(lens):
    return jax.tree.map(lambda a: a.astype(jnp.float32), drt_jax.load_lens(lens))


@pytest.mark.slow
def test_a_telescope_of_metres_is_told_a_camera_is_right():
    """The rounding that is measured, against path differences in float64: the singlet, 1e-4 waves,
    is silent; Hubble, 1e-2 waves, is not."""
    pupil = drt_jax.pupil.sobol_disc(48)[0]
    for name, field, loud in (("singlet", 0.1, False), ("hubble", 0.0005, True)):
        exact = drt_jax.wavefront(drt_jax.load_lens(name), field, np.inf, GREEN, pupil)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            found = drt_jax.wavefront(single(name), field, np.inf, GREEN, pupil)
        assert [bool(said)] == [loud] and found.opd.dtype == np.float32
        good = (np.asarray(exact.status) == 0) & (np.asarray(found.status) == 0)
        error = np.std((np.asarray(found.opd) - np.asarray(exact.opd))[good])
        told = rounding.path_rounding(single(name), [scene_of(single(name), field, np.inf, GREEN)])
        assert 0.3 * error < told < 3 * error and (told > 1e-3) == loud
        assert not loud or (len(said) == 1 and said[0].filename == __file__)


@pytest.mark.slow
def test_strehl_of_hubble():
    """1 on the axis; float32 once gave 0.008 without a word."""
    with pytest.warns(UserWarning, match=REMEDY):
        found = drt_jax.strehl(single("hubble"), jnp.zeros(1), np.inf, GREEN)
    np.testing.assert_allclose(found, 1, atol=0.02)


@pytest.mark.slow
def test_float32_stays():
    """Where a process has float64, too, dtypes follow the lens, and nothing is promoted. Traced,
    not compiled; one radius stands for azimuths."""
    lens, rule = single("hubble"), drt_jax.Clipped(6, "rotational")
    light = drt_jax.PsfModel("waves", beam_rule(8, "rotational", rule), 32)

    def both(lens):
        ratio = drt_jax.strehl(lens, jnp.zeros(1), jnp.inf, GREEN, rule)
        return ratio, drt_jax.psf(lens, 0.0, jnp.inf, GREEN, 0.01, 5, light)

    found = jax.tree.leaves(jax.eval_shape(both, lens))
    assert {a.dtype for a in found} == {np.dtype("float32")}
