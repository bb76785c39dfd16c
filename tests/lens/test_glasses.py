"""The table of the makers' glasses, compared with indices in OpticStudio's listings and with
makers' data."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import find_glass, nearest_glasses
from drt_jax.lens.glass import Dispersion, refractive_index
from drt_jax.lens.glasses import glass_makers, glass_names, indices

F, D, C, G = 0.4861327, 0.5875618, 0.6562725, 0.4358343
VISIBLE, NEAR = (F, D, C), (0.8, 1.05, 1.3)
# As OpticStudio's listings print them to 10 digits, by maker.
LISTED = {
    ("FK51", "SCHOTT"): (VISIBLE, (1.4905574408, 1.4865610802, 1.4847971397)),
    ("FK54", "SCHOTT"): (VISIBLE, (1.4403373452, 1.4370000012, 1.4355193893)),
    ("BK1", "SCHOTT"): (VISIBLE, (1.5156636409, 1.5100909531, 1.5076262556)),
    ("BK7", "SCHOTT"): ((1.064,), (1.5066348016,)),
    ("BK10", "SCHOTT"): (VISIBLE, (1.5029566103, 1.4978210089, 1.4955213933)),
    ("LAFN21", "SCHOTT"): (VISIBLE, (1.7999198414, 1.7883089381, 1.7833135149)),
    ("SF53", "SCHOTT"): (VISIBLE, (1.7463473341, 1.7283008787, 1.7209592054)),
    ("SK14", "SCHOTT"): (VISIBLE, (1.6100283152, 1.6031104337, 1.6000754753)),
    ("LAK10", "SCHOTT"): ((1.064,), (1.7031107520,)),
    ("SF10", "SCHOTT"): ((1.064,), (1.7021715816,)),
    ("N-KZFS4", "SCHOTT"): (VISIBLE, (1.6230023177, 1.6133601948, 1.6092169810)),
    ("NBFD5", "HOYA"): (VISIBLE, (1.7753428211, 1.7620012248, 1.7564173262)),
    ("FDS9", "HOYA"): (VISIBLE, (1.8720438101, 1.8466577150, 1.8365092902)),
    ("S-LAH58", "OHARA"): (NEAR, (1.8679218220, 1.8596091799, 1.8542980472)),
    ("S-LAL21", "OHARA"): (NEAR, (1.6934010534, 1.6878143248, 1.6840029378)),
    ("S-FPM2", "OHARA"): (NEAR, (1.5888751598, 1.5851328907, 1.5825498148)),
    ("S-NPH3", "OHARA"): (NEAR, (1.9244914466, 1.9075838923, 1.8979653438)),
    ("SEAWATER", "MISC"): (NEAR, (1.3349002648, 1.3309927250, 1.3269503486)),
}


def test_indices_that_opticstudio_lists():
    for (name, maker), (waves, wanted) in LISTED.items():
        found = indices(find_glass(name, maker), np.array(waves))
        np.testing.assert_allclose(found, wanted, rtol=0, atol=6e-11, err_msg=name)


# nd and vd as the makers print them beside their constants; the last two have L^4, L^-10, L^-12.
PRINTED = {
    "N-BK7": (1.51680, 64.17),
    "F2": (1.62004, 36.37),
    "S-BSM14": (1.603112, 60.64108),
    "FCD1": (1.49700, 81.61),
    "H-K9L": (1.51680, 64.20),
    "K-BK7": (1.51633, 64.1),
    "J-BAF12": (1.63930, 44.834133),
    "J-BASF2": (1.66446, 35.870305),
}


def test_nd_and_vd_that_the_makers_print():
    """By JAX's formula for all glasses together, therefore with the longest of Schott's sums; for
    Schott's own glasses also P_gF of their sheets."""
    media = Dispersion.of([find_glass(name) for name in PRINTED])
    assert media.schott.shape == (8, 9)
    d, f, c, g = np.asarray(refractive_index(media, jnp.array([D, F, C, G]))).T
    found = np.stack([d, (d - 1) / (f - c)], axis=1)
    np.testing.assert_array_less(np.abs(found - [*PRINTED.values()]), [[5e-6, 0.04]] * 8)
    np.testing.assert_array_less(np.abs(found - [*PRINTED.values()])[6:], 2e-6)
    np.testing.assert_allclose(((g - f) / (f - c))[:2], [0.5349, 0.5828], atol=5.1e-5)
    alone = [indices(find_glass(name), np.array([D]))[0] for name in PRINTED]
    np.testing.assert_allclose(d, alone, rtol=1e-15)


def test_the_longer_sum_is_finite_everywhere():
    media = Dispersion.of([find_glass("J-BASF2"), find_glass("air")])
    for dtype in (jnp.float32, jnp.float64):
        own = jax.tree.map(lambda a, dtype=dtype: a.astype(dtype), media)
        waves = jnp.array([0.0, 1e-4, 1e-2, 0.5, 1e6], dtype)
        n, slope = jax.jvp(lambda w, own=own: refractive_index(own, w), (waves,), (waves,))
        assert np.all(np.isfinite(n)) and np.all(n[1] == 1) and np.all(np.isfinite(slope))


def test_a_name_means_one_glass_or_asks():
    """SK16 without a maker is Hikari's, never N-SK16; SCHOTT's has the same constants."""
    new, old, plain = (find_glass(name) for name in ("N-SK16", "SK16_SCHOTT", "SK16"))
    assert (old.sellmeier, old.name, plain.maker) == (new.sellmeier, "SK16_SCHOTT", "HIKARI")
    assert plain.schott != old.schott and find_glass("SK16", "schott") == old
    assert find_glass("LAFN21_SCHOTT").name == "LAFN21"
    with pytest.raises(ValueError, match="of several makers, HIKARI, CDGM, SCHOTT, HOYA, .*BAF4_"):
        find_glass("BAF4")
    with pytest.raises(ValueError, match="'SK14' is not of OHARA but of SCHOTT"):
        find_glass("SK14", "OHARA")
    with pytest.raises(ValueError, match="unknown maker 'FOO'; makers: AMI, CDGM"):
        find_glass("SK14", "FOO")


def test_every_name_finds_its_glass():
    names = glass_names()
    assert len(names) > 2000 and len({*names}) == len(names)
    for name in names:
        glass = find_glass(name)
        assert glass.name == name and (glass.source or name == "air")
        n = indices(glass, np.linspace(*glass.range, 5))
        assert np.all((n > 1) & (n < 8)) or name == "air"
    begin = time.perf_counter()
    find_glass("N-BK7")
    assert time.perf_counter() - begin < 1e-3


def test_nearest_glasses():
    first, *_, last = nearest_glasses(1.5168, 64.17, ("Schott", "OHARA"), 20)
    assert first.glass.name == "N-BK7" and first.distance < 1e-4 < last.distance
    assert {"SCHOTT", "OHARA"} >= {near.glass.maker for near in nearest_glasses(1.6, 50, ["OHARA"])}
    assert last.distance == pytest.approx(np.hypot(last.nd - 1.5168, (last.vd - 64.17) / 100))
    with pytest.raises(ValueError, match="unknown maker 'FOO'"):
        nearest_glasses(1.5, 60, ["FOO"])
    assert "HOYA" in glass_makers()


def test_temperature_expansion_and_status():
    """From data sheets: SCHOTT's of N-BK7, Ohara's of S-FPL51 (expansion 131e-7/K, at 25 C); and
    glasses that SCHOTT no longer lists, such as N-LASF31, which N-LASF31A replaced, or sells on
    inquiry."""
    glass = find_glass("N-BK7")
    assert glass.thermal == (1.86e-6, 1.31e-8, -1.37e-11, 4.34e-7, 6.27e-10, 0.17)
    assert (glass.expansion, glass.celsius, glass.status) == (7.1, 20.0, "preferred")
    ohara = find_glass("S-FPL51")
    assert (ohara.expansion, ohara.celsius, ohara.status) == (13.1, 25.0, "standard")
    status = {"N-LASF31": "obsolete", "N-LASF31A": "preferred", "SF6G05": "special"}
    status |= {
        "SF15": "obsolete",
        "BK7_SCHOTT": "obsolete",
        "SF66": "obsolete",
        "N-PK51": "preferred",
    }
    assert {name: find_glass(name).status for name in status} == status
    assert find_glass("E48R").thermal == () and find_glass("PMMA").expansion == 60
