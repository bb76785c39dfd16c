"""Lenses written and read back."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import LensError, lens_names, load_lens, load_system, save_lens
from drt_jax.__main__ import main
from drt_jax.files import write
from drt_jax.files.load import system_for

ODD = {
    "name": "odd",
    "object": {"glass": "water"},
    "surfaces": [
        {"radius": 30.1, "thickness": 0.1, "nd": 1.8, "vd": 30.3, "conic": -0.7}
        | {"obscuration": [{"circle": 1 / 3}, {"ellipse": [1 / 7, 3], "centre": [1 / 9, 0]}]},
        {"radius": -1 / 3, "thickness": 1 / 3, "glass": "F2", "coefficients": {4: 1e-300, 6: 0.1}},
        {"curvature": 0, "thickness": 2.0, "stop": True}
        | {"aperture": {"rectangle": [0.3, 1 / 7]}, "obscuration": {"rectangle": [0.1, 5]}},
        {"form": "biconic", "radius": 77.7, "radius_x": 55.5, "conic_x": 0.3, "thickness": 30.0},
        {"form": "polynomial_xy", "radius": -9e9, "coefficients": {"x1y1": 1e-3}, "mirror": True}
        | {"thickness": -12.0, "tilt": [0.1, 45, -7.7], "decentre": [0, 1 / 7]},
        {"form": "qbfs", "radius": 99, "norm_radius": 7.1, "coefficients": {0: 0.1, 3: 1e-3}}
        | {"thickness": -3.0},
        {"form": "zernike", "radius": 99, "norm_radius": 6.7, "coefficients": {7: 1e-3}}
        | {"thickness": -12.0, "index": 1.5},
    ],
    "sensor_tilt": [1, 2, 3],
}
STOP = {"semi_diameter": 5.0, "stop": True}
FOLDED = {
    "surfaces": [
        {"radius": 30.0, "thickness": 0.1, "glass": "F2", "stop": True, "semi_diameter": 1.0}
        | {"phase": {"order": -2, "coefficients": {2: 1 / 3, 6: 0.1}}},
        {"radius": "inf", "thickness": 1.0, "phase": {"form": "linear", "coefficients": {"y": 7}}},
        {"radius": "inf", "mirror": True, "thickness": -3.0, "tilt": [45, 0, 0]},
    ],
    "elements": [
        {"surfaces": ["sensor", "sensor"], "about": 2, "tilt": [90.0, 0, 0.1]},
        {"surfaces": [0, 1], "shift": [0.1, 1 / 7, 0], "pivot": 0.3},
    ],
}
CASES = {
    **{name: name for name in lens_names()},
    "odd": ODD,
    "folded": FOLDED,
    "glasses": {
        "glasses": {
            "SK16": {"schott": [2.6, -0.015, 0.01, 0.0016, 0, 0], "range": [0.4, 0.7]},
            "mine": {"sellmeier": [1.2, 0.5, 0.01, 100.0], "schott": [1.1, 0, 0, 0, 0, 0]},
            "constant": {"schott": [2.25, 0, 0, 0, 0, 0]},
        },
        "object": {"glass": "constant"},
        "surfaces": [
            {"radius": 50.0, "thickness": 4.0, "glass": "SK16"},
            {"radius": 90.0, "thickness": 4.0, "glass": "mine"},
            {"radius": "inf", "thickness": 50.0, "glass": "water", **STOP},
        ],
    },
    "index": {
        "surfaces": [
            {"radius": 50.0, "thickness": 4.0, "index": 1.1, "coefficients": {4: 0, 6: 0}},
            {"radius": "inf", "thickness": 50.0, "stop": True, "semi_diameter": 5.0},
        ]
    },
}


def test_a_lens_that_a_program_returns_keeps_its_glasses(tmp_path):
    """Its names are lost, because a program serves lenses of all names; the glasses follow from the
    constants."""
    lens = load_lens("double_gauss")
    returned = jax.jit(lambda lens: lens)(lens)
    assert returned.name == "" and returned.glasses[1] == "glass 1"
    save_lens(returned, tmp_path / "lens.yaml")
    assert load_lens(tmp_path / "lens.yaml").glasses == lens.glasses


@pytest.mark.parametrize("name", CASES)
def test_a_lens_comes_back(name, tmp_path):
    """All static fields, and every number to the last digit; numbers that no person typed (which
    differ in the last bit from 12 digits) exactly."""
    lens = load_lens(CASES[name])
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert again.glasses == lens.glasses and again.name == (lens.name or again.name)
    assert jax.tree.structure(again) == jax.tree.structure(dataclasses.replace(lens))
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(lens), strict=True):
        np.testing.assert_array_max_ulp(np.asarray(a), np.asarray(b), 1)
    for field in ("curvature", "conic", "coefficients", "thickness", "sensor", "dispersion"):
        pairs = zip(jax.tree.leaves(getattr(again, field)), jax.tree.leaves(getattr(lens, field)))
        for a, b in (map(np.ravel, pair) for pair in pairs):
            typed = np.array([float(f"{x:.12g}") for x in b.tolist()])
            assert np.all((a == b) | (a == typed)), field


def test_numbers_are_written_as_a_person_types_them(tmp_path):
    """Also those that rounding has changed: a gap in front of the sensor, wavelengths in nm.
    Numbers that no person typed keep their last bit."""
    lens = load_lens("cooke_triplet")
    third = float(np.nextafter(1 / 300, 1))
    curvature = lens.curvature.at[0].set(np.nextafter(0.02, 1)).at[1].set(third)
    conic = lens.conic.at[2].set(np.nextafter(1e-5, 1))
    lens = dataclasses.replace(lens, curvature=curvature, conic=conic)
    lens = dataclasses.replace(lens, sensor=jnp.sum(lens.thickness) + 45.047)
    texts = {}
    for end in (".yaml", ".zmx", ".seq"):
        save_lens(lens, tmp_path / f"lens{end}")
        texts[end] = (tmp_path / f"lens{end}").read_text()
        again = load_lens(tmp_path / f"lens{end}")
        assert float(again.curvature[0]) == 0.02 and float(again.curvature[1]) == third
        assert float(again.conic[2]) == 1e-5
    assert "conic: 1.0e-05" in texts[".yaml"]
    assert "DISZ 45.047\n" in texts[".zmx"] and "CURV 0.02\n" in texts[".zmx"]
    assert "WL 587.5618\n" in texts[".seq"] and " 45.047\n" in texts[".seq"]
    assert load_system(tmp_path / "lens.seq").wavelengths.tolist() == [0.5875618]


def test_the_patent_lens_comes_back(shared, tmp_path):
    lens = load_lens(shared / "patent_rf50.yaml")
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert again.glasses == lens.glasses
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(lens), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_lens_that_an_optimiser_moved(tmp_path):
    """Numbers that no person typed; among them the Abbe number of a model glass."""
    lens = load_lens(ODD)
    change = np.random.default_rng(0).normal(size=100)
    leaves, structure = jax.tree.flatten(lens)
    moved = [leaves[k] * (1 + 1e-3 * change[k]) for k in range(len(leaves))]
    found = jax.tree.unflatten(structure, moved)
    found = dataclasses.replace(found, dispersion=lens.dispersion)
    model = found.dispersion.model.at[1].mul(1.01)
    found = dataclasses.replace(found, dispersion=dataclasses.replace(lens.dispersion, model=model))
    save_lens(found, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_max_ulp(np.asarray(a), np.asarray(b), 1)


def test_glasses_that_an_optimiser_moved(tmp_path):
    """Two elements of one glass, changed differently, and a third with the glass of the
    catalogue."""
    rows = [
        {"radius": 50, "thickness": 4, "glass": "SK16"},
        {"radius": -50, "thickness": 1, "glass": "F2"},
        {"radius": 90, "thickness": 4, "glass": "SK16"},
        {"radius": 70, "thickness": 90} | STOP,
    ]
    lens = load_lens({"surfaces": rows})
    schott = lens.dispersion.schott.at[1, 0].add(1e-3).at[3, 1].add(1e-5)
    moved = dataclasses.replace(
        lens, dispersion=dataclasses.replace(lens.dispersion, schott=schott)
    )
    save_lens(moved, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert again.glasses == ("air", "SK16", "F2", "SK16*", "air")
    np.testing.assert_array_equal(again.dispersion.ranges, lens.dispersion.ranges)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(moved), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_a_prescription_cannot_hold(tmp_path):
    lens = load_lens("singlet")
    curved = dataclasses.replace(lens, curvature=lens.curvature.at[-1].set(0.01))
    with pytest.raises(LensError, match="sensor"):
        save_lens(curved, tmp_path / "lens.yaml")
    patent = load_lens({"surfaces": [{"radius": 9, "nd": 1.5, "vd": 50, "thickness": 9} | STOP]})
    melted = dataclasses.replace(patent.dispersion, strength=patent.dispersion.strength + 1e-6)
    with pytest.raises(LensError, match=r"glasses\[1\]: a prescription has nd and vd and no"):
        save_lens(dataclasses.replace(patent, dispersion=melted), tmp_path / "lens.yaml")
    with pytest.raises(LensError, match="cannot be written"):
        save_lens(lens, tmp_path / "nowhere" / "lens.yaml")
    assert not any(tmp_path.iterdir()) and jnp.all(jnp.isfinite(lens.curvature))


KINDS = (".yaml", ".zmx", ".seq")
FRONT = {"radius": 50.0, "thickness": 5.0, "semi_diameter": 5.0, "stop": True}
BACK = {"radius": -50.0, "thickness": 47.45, "semi_diameter": 5.0}


def singlet(**keys):
    return load_lens({"surfaces": [FRONT | keys, BACK]})


@pytest.mark.parametrize("kind", KINDS)
def test_a_constant_index_is_a_glass_of_every_file(kind, tmp_path):
    """n = 1.5 is not air; what is read is written again."""
    lens = singlet(index=1.5)
    save_lens(lens, tmp_path / f"one{kind}")
    for other in KINDS:
        save_lens(load_lens(tmp_path / f"one{kind}"), tmp_path / f"two{other}")
        again = load_lens(tmp_path / f"two{other}")
        np.testing.assert_array_equal(again.index([0.45, 0.7]), [[1, 1], [1.5, 1.5], [1, 1]])
        np.testing.assert_array_equal(again.curvature, lens.curvature)


def test_a_model_glass_of_another_dispersion_is_a_private_glass(tmp_path):
    """It has the same indices at F, d, C; at other wavelengths the error is at most the reported
    one."""
    lens = singlet(nd=1.6204, vd=60.3, dPgF=0.02)
    with pytest.warns(UserWarning, match="0.365 to 1.014 um they differ by .* at most") as said:
        save_lens(lens, tmp_path / "own.seq")
    again = load_lens(tmp_path / "own.seq")
    lines, all_waves = [0.4861327, 0.5875618, 0.6562725], np.linspace(0.366, 1.013, 50)
    np.testing.assert_allclose(again.index(lines), lens.index(lines), rtol=0, atol=1e-12)
    worst = float(str(said[0].message).rpartition(" at most")[0].rpartition(" ")[2])
    off = np.abs(np.asarray(again.index(all_waves) - lens.index(all_waves))).max()
    assert worst / 2 < off < 1.5 * worst < 1e-4


@pytest.mark.parametrize("kind", [".zmx", ".seq"])
@pytest.mark.filterwarnings("ignore:.*glasses of a code have its nd and vd")
def test_model_glasses_survive_conversions(kind, tmp_path):
    """A model glass of .zmx on the normal line, except for rounding, is a model glass in each later
    file."""
    save_lens(singlet(nd=1.6204, vd=60.3), tmp_path / "one.zmx")
    for one, two in (("one.zmx", f"two{kind}"), (f"two{kind}", "three.zmx")):
        save_lens(load_lens(tmp_path / one), tmp_path / two)
    again = load_lens(tmp_path / "three.zmx").dispersion
    assert again.dPgF is None
    np.testing.assert_allclose(again.model[1], [1.6204, 60.3], rtol=1e-14)


def test_what_is_read_back_otherwise_is_not_written(tmp_path, monkeypatch):
    """An error names the difference, and the existing file is not changed."""
    lens = singlet(index=1.5)
    others = {
        "curvature[1] -0.02": dataclasses.replace(lens, curvature=lens.curvature.at[1].mul(1.001)),
        "thickness[0] 5": dataclasses.replace(lens, thickness=lens.thickness + 1e-6),
        "sensor 52.45": dataclasses.replace(lens, sensor=lens.sensor + 0.01),
        "index[1, 0] 1.5": singlet(index=1.51),
        "stop 0": load_lens({"surfaces": [{**FRONT, "index": 1.5, "stop": False}, BACK | STOP]}),
        "apertures": dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[1].set(4.0)),
        "stop's semi_diameter 5": dataclasses.replace(
            lens, semi_diameter=lens.semi_diameter.at[0].set(4.0)
        ),
    }
    for kind in KINDS:
        path = tmp_path / f"lens{kind}"
        path.write_text("before")
        for name, other in others.items():
            if name == "sensor 52.45" and kind != ".yaml":
                continue  # there it is a thickness
            text = {".zmx": write.zmx_text, ".seq": write.seq_text}.get(kind, write._yaml_text)
            wrong = text([system_for(other)])
            place = "zmx_text" if kind == ".zmx" else "seq_text" if kind == ".seq" else "_yaml_text"
            with monkeypatch.context() as patch:
                patch.setattr(write, place, lambda system, wrong=wrong: wrong)
                with pytest.raises(LensError) as error:
                    save_lens(lens, path)
            assert f"not written: what is read back differs: {name}" in str(error.value)
            assert path.read_text() == "before"
        wrong_way = dataclasses.replace(lens, thickness=-lens.thickness)
        with pytest.raises(LensError, match="must be positive.*not written"):
            save_lens(wrong_way, path)
        assert path.read_text() == "before"


@pytest.mark.parametrize("path", ["lens.len", "lens", "lens.txt", "lens.zmx.gz"])
def test_endings_of_no_kind_of_file(path, tmp_path):
    lens = singlet(index=1.5)
    with pytest.raises(LensError, match=r"ends in .yaml, .yml, .zmx, .seq"):
        save_lens(lens, tmp_path / path)
    with pytest.raises(LensError, match=r"ends in .yaml, .yml, .zmx, .seq"):
        load_lens(tmp_path / path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_rings_and_other_apertures(kind, tmp_path):
    """A circle inside a circle is the annular aperture of .zmx; other surfaces have one shape
    each."""
    plane = {"curvature": 0.0, "thickness": 2.0}
    shapes = [
        {"semi_diameter": 4.0, "obscuration": {"circle": 1.0}},
        {
            "aperture": {"circle": 4.0, "centre": [1, 2]},
            "obscuration": {"circle": 1.0, "centre": [1, 2]},
        },
        {"aperture": {"ellipse": [3.0, 4.0]}},
        {"obscuration": {"ellipse": [1.0, 2.0]}},
        {"obscuration": {"rectangle": [1.0, 2.0], "centre": [0, 0.5]}},
    ]
    rows = [{**FRONT, "index": 1.5, "obscuration": {"circle": 1.0}}, BACK]
    lens = load_lens({"surfaces": [*rows, *(plane | own for own in shapes)]})
    save_lens(lens, tmp_path / f"own{kind}")
    again = load_lens(tmp_path / f"own{kind}")
    assert (again.apertures.kinds, again.apertures.blocks) == (
        lens.apertures.kinds,
        lens.apertures.blocks,
    )
    np.testing.assert_array_equal(again.apertures.half, lens.apertures.half)
    np.testing.assert_array_equal(again.apertures.centre, lens.apertures.centre)
    np.testing.assert_array_equal(again.semi_diameter, lens.semi_diameter)
    if kind == ".zmx":
        text = (tmp_path / "own.zmx").read_text()
        assert text.count("CLAP 1.0 4.0 0") == 2 and "OBDC 1.0 2.0" in text
        off = {"semi_diameter": 4.0, "obscuration": {"circle": 1.0, "centre": [0, 1]}}
        lens = load_lens({"surfaces": [*rows, plane | off]})
        what = "has a clear circle and a blocking circle; .* planes? .*, or save as .yaml"
        with pytest.raises(LensError, match=what):
            save_lens(lens, tmp_path / "two.zmx")


def test_a_sensor_that_nearly_touches_and_a_toroidal_grating(tmp_path):
    """A gap of 1e-6 mm, which rounding of a sum makes smaller; TOROGRAT, by its radius."""
    rows = [FRONT | {"index": 1.5}, BACK | {"thickness": 104.42}]
    glass = {"curvature": 0.0, "thickness": 1e-6}
    grating = {"form": "toroid", "radius": 90.0, "radius_x": -70.0, "thickness": 0.1 + 0.2}
    grating |= {"phase": {"form": "linear", "order": -2, "coefficients": {"y": 300.0}}}
    plate = {"curvature": 0.0, "thickness": 3.3, "index": 1.6}
    lens = load_lens({"surfaces": [*rows, grating, plate, glass]})
    for kind in (".zmx", ".yaml"):
        save_lens(lens, tmp_path / f"own{kind}")
        again = load_lens(tmp_path / f"own{kind}")
        np.testing.assert_allclose(again.coefficients, lens.coefficients, rtol=1e-15)
        np.testing.assert_allclose(again.phase.coefficients, [[300.0]], rtol=1e-15)
        assert again.phase.order == -2 and again.forms == lens.forms


USES = {
    "angle": ("inf", [[0, 0], [1, 5]]),
    "object height": ("200", [[0, 0], [1, 5]]),
    "paraxial image height": ("inf", [[0, k] for k in range(15)]),
    "real image height": ("inf", [[0, 0], [1, 5]]),
}


def lost_parts_are_named(system, path, monkeypatch):
    """A writer that loses a part of fields, wavelengths or aperture writes no file."""
    others = {
        "field_kind angle, read back object height": {"field_kind": "object height"},
        "primary 1, read back 2": {"primary": 2},
        "heights: 2 of them, read back 1": {
            key: getattr(system, key)[:1] for key in ("heights", "field_weights", "vignetting")
        },
        "heights[1, 0] 1, read back 2": {"heights": 2 * system.heights},
        "field_weights[1] 2, read back 1": {"field_weights": np.ones(2)},
        "vignetting[0, 0] 0.127": {"vignetting": 0 * system.vignetting},
        "wavelengths[1] 0.65, read back 0.7": {"wavelengths": np.array([0.48, 0.7, 0.55])},
        "wavelength_weights[1] 2": {"wavelength_weights": np.ones(3)},
        "distance inf, read back 100": {"distance": 100.0},
    }
    name, before = f"{path.suffix[1:]}_text", path.read_text()
    for what, other in others.items():
        wrong = getattr(write, name)([dataclasses.replace(system, **other)])
        with monkeypatch.context() as patch:
            patch.setattr(write, name, lambda _, wrong=wrong: wrong)
            with pytest.raises(LensError) as error:
                save_lens(system, path)
        assert f"not written: what is read back differs: {what}" in str(error.value)
        assert path.read_text() == before


@pytest.mark.parametrize("kind", [".zmx", ".seq"])
@pytest.mark.parametrize("field_kind", USES)
def test_a_lens_with_its_fields_and_wavelengths(kind, field_kind, tmp_path, monkeypatch):
    """All that `load_system` reads is written: distance, fields, weights, vignetting,
    wavelengths."""
    far, heights = USES[field_kind]
    count = len(heights)
    vignetting = np.random.default_rng(0).uniform(0, 0.2, (count, 5))
    vignetting[:, 4] = 0.5 if kind == ".zmx" else 0
    system = dataclasses.replace(
        system_for(singlet(glass="N-BK7")),
        distance=float(far),
        field_kind=field_kind,
        heights=np.array(heights, float),
        field_weights=np.arange(1.0, count + 1),
        vignetting=vignetting,
        wavelengths=np.array([0.48, 0.65, 0.55]),
        wavelength_weights=np.array([1.0, 2.0, 0.5]),
        primary=1,
        ray_aiming="off",
    )
    save_lens(system, tmp_path / f"own{kind}")
    again = load_system(tmp_path / f"own{kind}")
    for key in ("heights", "field_weights", "wavelengths", "wavelength_weights"):
        np.testing.assert_allclose(getattr(again, key), getattr(system, key), rtol=1e-15)
    np.testing.assert_allclose(again.vignetting, vignetting, rtol=0, atol=1e-15)
    assert (again.distance, again.primary, again.field_kind) == (float(far), 1, field_kind)
    assert again.ray_aiming == ("off" if kind == ".zmx" else "chief")
    np.testing.assert_allclose(again.lens.semi_diameter, system.lens.semi_diameter, rtol=1e-12)
    if field_kind == "angle":
        lost_parts_are_named(system, tmp_path / f"own{kind}", monkeypatch)
    if kind == ".seq" and field_kind == "angle":
        turned = dataclasses.replace(system, vignetting=vignetting + 0.1)
        with pytest.raises(LensError, match="vignetting: .seq files hold no rotation"):
            save_lens(turned, tmp_path / "turned.seq")
        with pytest.warns(UserWarning, match="fields, wavelengths and vignetting are not written"):
            save_lens(system, tmp_path / "own.yaml")


def test_convert_keeps_fields_and_wavelengths(tmp_path, capsys):
    system = dataclasses.replace(
        system_for(singlet(glass="N-BK7")),
        heights=np.array([[0, 0], [0, 7.0]]),
        field_weights=np.ones(2),
        vignetting=np.zeros((2, 5)),
    )
    save_lens(system, tmp_path / "one.zmx")
    main(["convert", str(tmp_path / "one.zmx"), str(tmp_path / "two.seq")])
    np.testing.assert_array_equal(load_system(tmp_path / "two.seq").heights, system.heights)
    assert "2 surfaces, is written" in capsys.readouterr().out
