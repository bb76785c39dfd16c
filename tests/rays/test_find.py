"""The searches for rays: aiming, the polish, the fan."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from drt_jax import Gauss, Scene, Status, load_lens, spot_diagram, trace_rays
from drt_jax.pupil import hexapolar
from drt_jax.rays import aim, fermat, find, linear

from ..conftest import assert_close
from ..known import aims, search
from .problems import crossings, gradient, problem, random_like
from .systems import COLOURS


@jax.jit
def aimed(lens, scene, points, off):
    """Result of aiming that starts `off` mm from the paraxial launch."""
    system, target = aims(lens, scene, points)
    sizes = aim.beam_size(system, target)
    launch = aim.paraxial_launch(system, target, sizes[1])
    start = tuple(a + b for a, b in zip(launch, off, strict=True))
    return aim.aim(system, target, start, sizes)


ZERO = tuple(jnp.zeros((len(COLOURS), 5)) for _ in range(2))


@pytest.mark.slow
def test_aiming_from_crude_starts():
    """The same launch from starts 3 mm around; stop points that cannot be reached are reported, and
    change no other ray."""
    lens, scene, points, _ = problem("tilted")
    exact = aimed(lens, scene, points, ZERO)
    assert np.all(exact.status == Status.OK) and int(exact.steps) <= 6
    off = tuple(3 * a for a in random_like(ZERO))
    crude = aimed(lens, scene, points, off)
    assert np.all(crude.status == Status.OK) and int(crude.steps) <= 12
    # A Newton step from a millionth of the beam radius leaves an error of some 1e-12 of it.
    assert_close(crude.launch, exact.launch, 1e-10)
    far = tuple(p.at[3].set(30.0) for p in points)
    status = np.asarray(aimed(lens, scene, far, ZERO).status)
    assert np.all((status == Status.OK) == (np.arange(5) != 3))


@jax.jit
def polished(lens, scene, points, hits, active):
    """Result of `BlockNewton` for hits."""
    system, target = aims(lens, scene, points)

    def function(hits, args):
        system, target, _ = args
        path = fermat.geometry(hits, system)
        return (linear.shortfall(path, system, target), path), None

    eps = float(jnp.finfo(hits[0].dtype).eps)
    newton = find.BlockNewton(rtol=2 * eps, atol=2 * eps)
    args = system, target, active
    found = optx.root_find(function, newton, hits, args, has_aux=True, max_steps=16, throw=False)
    successful = found.result == optx.RESULTS.successful
    return found.value, found.state.solved, found.stats["num_steps"], successful


@pytest.mark.slow
def test_newton_from_the_crudest_start():
    """With every hit at the stop point, all rays are found within 8 steps. Inactive rays do not
    move; a ray without a solution is reported, stays finite and does not change others."""
    lens, scene, points, found = problem("tilted")
    start = tuple(
        jnp.broadcast_to(c, h.shape) for c, h in zip(crossings(lens, scene, points), found.hits)
    )
    every = jnp.ones(found.status.shape, bool)
    hits, solved, steps, successful = polished(lens, scene, points, start, every)
    assert np.all(solved) and successful and int(steps) <= 8
    assert_close(hits, found.hits, 1e-13)
    hits, solved, steps, successful = polished(lens, scene, points, start, ~every)
    assert np.all(solved) and successful and int(steps) == 0
    assert_close(hits, start, 0)
    hard = np.arange(5) == 3
    far = tuple(jnp.where(hard, 30.0, p) for p in points)
    hits, solved, _, successful = polished(lens, scene, far, start, every)
    assert np.all(np.asarray(solved) == ~hard) and not successful
    for mine, wanted in zip(hits, found.hits, strict=True):
        mine, wanted = np.asarray(mine), np.asarray(wanted)
        assert np.all(np.isfinite(mine))
        np.testing.assert_allclose(mine[:, :, ~hard], wanted[:, :, ~hard], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_hits_that_rounding_would_turn_are_not_accepted():
    """Two equal surfaces at a distance of 1e-9 mm: rays exist, but rounding changes their
    directions."""
    lens, scene, points, _ = problem("meridional")
    same = {k: getattr(lens, k).at[1].set(getattr(lens, k)[0]) for k in ("curvature", "conic")}
    same["coefficients"] = lens.coefficients.at[1].set(lens.coefficients[0])
    close = dataclasses.replace(lens, thickness=lens.thickness.at[0].set(1e-9), **same)
    status = np.asarray(search(close, scene, points).status)
    wide = np.abs(np.asarray(points[0])) > 0.2
    assert np.all(status[:, wide] == Status.UNCONVERGED)
    apart = dataclasses.replace(close, thickness=lens.thickness.at[0].set(1e-6))
    assert np.all(search(apart, scene, points).status == Status.OK)


@pytest.mark.slow
def test_a_polish_that_takes_one_step_shorter_than_rounding_of_a_mm():
    """All surfaces within 0.2 um, at the centre of the stop: hits of 1e-5 mm, for which 7e-17 is
    large."""
    bent = [{"radius": -61.193, "index": n, "thickness": t} for n, t in ((1.93, 1e-4), (1.9, 1e-6))]
    bent.append({"radius": -61.193, "thickness": 1e-4, "semi_diameter": 12.5, "stop": True})
    bent += [{"radius": "inf", "index": 1.92, "thickness": 1e-6}, {"radius": "inf"}]
    lens = load_lens({"surfaces": bent, "sensor": 1.0})
    lens = dataclasses.replace(lens, sensor=jnp.asarray(2.03e-4))
    field = (-0.20932616, 0.06755307)
    rays = trace_rays(
        lens, Scene.point(field, 200.0, (0.55,)), np.array([[0, 0], [0.5, 0], [0.1, 0.2]])
    )
    assert np.all(rays.status == Status.OK)
    np.testing.assert_allclose(rays.points[0, 0, 2, :2], 0, atol=1e-18)


def hostile(seed):
    """A lens with the structure of the "tilted" one, and a difficult scene."""
    generator = np.random.default_rng(seed)
    lens, scene, *_ = problem("tilted")
    bent = lens.curvature * generator.uniform(-4, 6, lens.curvature.shape)
    wide = lens.semi_diameter.at[lens.stop].mul(generator.uniform(0.5, 2))
    conic = lens.conic + generator.normal(size=lens.conic.shape)
    lens = dataclasses.replace(lens, curvature=bent, conic=conic, semi_diameter=wide)
    return lens, dataclasses.replace(scene, field=jnp.asarray(generator.uniform(-0.9, 0.9, 2)))


@pytest.mark.slow
def test_hostile_lenses():
    """All numbers are finite; rays that are found cross the stop at their points; and the fan finds
    rays that the first aim does not, in addition to those that it finds."""
    _, _, points, found = problem("tilted")
    weights = random_like(found.hits)
    saved = mixed = lost = 0
    for seed in range(40):
        lens, scene = hostile(seed)
        found, first = search(lens, scene, points), aimed(lens, scene, points, ZERO)
        good = np.asarray(found.status) == Status.OK
        for hits, target in zip(found.hits, crossings(lens, scene, points), strict=True):
            ours = np.asarray(hits)[2]  # the stop is the third active surface
            np.testing.assert_allclose(ours[good], np.asarray(target)[good], rtol=0, atol=1e-12)
        every = found.hits, gradient(lens, scene, points, found, weights)
        assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(every))
        late = good & (np.asarray(first.status) != Status.OK)
        saved, lost = saved + np.sum(late), lost + np.sum(~good)
        mixed += np.any(late) and np.any(good & ~late)
    print(saved, mixed, lost)
    assert saved >= 20 and mixed >= 2 and lost >= 20


@pytest.mark.slow
def test_the_fan_under_vmap():
    """Scenes that need the fan together with others that do not: each has the same result as
    alone."""
    _, _, points, _ = problem("tilted")
    scenes = [hostile(seed) for seed in range(8)]
    alone = [search(*scene, points) for scene in scenes]
    batch = jax.tree.map(lambda *a: jnp.stack(a), *scenes)
    together = jax.jit(jax.vmap(search, (0, 0, None)))(*batch, points)
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(together.status[i], one.status)
        for mine, wanted in zip(together.hits, one.hits, strict=True):
            np.testing.assert_allclose(mine[i], wanted, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_several_rays_that_are_sought():
    """Two rays of a bundle that the first aim does not find: each starts from its own nearest
    rays."""
    radius, gap = (-21.77, -9.051, 14.174, 9.3, "inf"), (2.219, 1.995, 6.392, 6.941, 22.718)
    index = (1.804, 1, 1.402, 1, 1)
    names = "radius", "thickness", "index"
    rows = [dict(zip(names, row, strict=True)) for row in zip(radius, gap, index, strict=True)]
    rows[-1] |= {"stop": True, "semi_diameter": 8.1456}
    points = [[0, 0], [0, 1], [0, -1], [1, 0], [-0.113, 0.078], [0.866, 0.282], [0.648, -0.427]]
    rays = trace_rays(load_lens({"surfaces": rows}), Scene.point(0.23138, 1e3, [0.55]), points)
    assert np.all(rays.status == Status.OK)


@pytest.mark.slow
def test_where_neighbouring_surfaces_cross_a_ray_is_told_so():
    """A thin plano-convex lens: the sphere, R = 20, lies behind the plane, 2 mm away, from y^2 =
    20^2 - 18^2 on. Snell's law would take a ray back to the plane and through a stop behind."""
    surfaces = [
        {"radius": 20.0, "index": 1.5, "thickness": 6.0},
        {"radius": "inf", "thickness": 4.0},
        {"radius": "inf", "thickness": 30.0, "stop": True, "semi_diameter": 10.0},
    ]
    lens = load_lens({"surfaces": surfaces})
    lens = dataclasses.replace(lens, thickness=lens.thickness.at[0].set(2.0))
    start = np.array([0.0, 5.0, 8.6, 8.8, 9.5])
    sag = 20 - np.sqrt(400 - start**2)
    lean = np.arcsin(start / 20)
    inside = np.arcsin(np.sin(lean) / 1.5) - lean
    plane = start + (2 - sag) * np.tan(inside)
    stop = plane + 4 * np.tan(np.arcsin(1.5 * np.sin(inside)))
    pupil = np.stack([0 * stop, stop / 10], axis=-1)
    rays = trace_rays(lens, Scene.point(0.0, np.inf, 0.55), pupil)
    crossed = start**2 > 20**2 - 18**2
    np.testing.assert_array_equal(rays.status[0], np.where(crossed, Status.CROSSED, Status.OK))
    np.testing.assert_allclose(rays.points[0, ~crossed, 0, 1], start[~crossed], atol=1e-12)
    found = spot_diagram(lens, Scene.radians([0.0], np.inf, 0.55), Gauss(4, "rotational"))
    rings = np.concatenate([hexapolar(6)[0], [[0, 1]] * 48])
    edge = np.interp(np.sqrt(76), start, stop) / 10
    share = np.mean(np.linalg.norm(rings, axis=1) > edge)
    assert abs(found.left_out[0, 0] - share) < 0.02 and share > 0.05
