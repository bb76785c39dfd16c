"""The Fermat system compared with automatic differentiation and geometry, `linear` with dense
solves.

For a stop that bends no light and one that does, tilted systems, one component and two.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import load_lens
from drt_jax.rays import fermat, linear
from drt_jax.rays.system import dot

from .systems import (
    COLOURS,
    DISTANCE,
    corners,
    meridional,
    on_surface,
    rough_path,
    system_with,
    wide,
)

CASES = {
    "meridional": ("between", 1, False),
    "meridional, active stop": ("active", 1, False),
    "centred": ("between", 2, False),
    "tilted, stop in front": ("in front", 2, True),
    "tilted, active stop": ("active", 2, True),
}
RAYS = 3
ALL = jnp.ones((len(COLOURS), RAYS), bool)


def equations(hits, system):
    """F and the label."""
    path = fermat.geometry(hits, system)
    force = tuple(f[:-1] for f in fermat.residual(path, system))
    return force, fermat.label(path, system)


class Answers(NamedTuple):
    """path, gradient: of a bundle. equations: F and the label. columns: their Jacobian, with a
    leading axis (R D), the derivatives by one component of one hit, for all rays together. solved,
    pulled: result of `linear` for forces and a shift, and its transpose applied to `other`."""

    path: jax.Array
    gradient: tuple
    equations: tuple
    columns: tuple
    solved: tuple
    pulled: tuple


@jax.jit
def answers(system, hits, good, forces, shift, other):
    """All results together, in one program for each kind of system."""
    gradient = jax.grad(lambda w: jnp.sum(fermat.optical_path(w, system)))(hits)
    rows, dim = len(system.forms), len(hits)
    units = jnp.eye(rows * dim).reshape(-1, dim, rows, 1, 1)
    units = jnp.broadcast_to(units, (*units.shape[:3], *hits[0].shape[1:]))
    both, push = jax.linearize(lambda w: equations(w, system), hits)
    columns = jax.vmap(push)(tuple(units[:, d] for d in range(dim)))
    path = fermat.geometry(hits, system)
    still = tuple(jnp.zeros_like(a) for a in path.before)

    def solve(forces, shift):
        forces = tuple(jnp.pad(f, ((0, 1), (0, 0), (0, 0))) for f in forces)
        push = linear.RightSide(forces, still, tuple(a[0] for a in still), shift)
        return linear.solve(path, system, good, push)[0]

    solved, pull_back = jax.vjp(solve, forces, shift)
    length = fermat.optical_path(hits, system)
    return Answers(length, gradient, both, columns, solved, pull_back(other))


def given(hits):
    """Random forces, shift and `other` for a bundle."""
    generator = np.random.default_rng(0)
    dim, shape = len(hits), hits[0].shape
    shapes = (shape[0] - 1, *shape[1:]), shape[1:], shape
    return tuple(tuple(jnp.asarray(generator.normal(size=(dim, *s)))) for s in shapes)


def flat(vector, rest=()):
    """(W, Q, all components) of D arrays (R, W, Q) and D arrays (W, Q)."""
    rows = [np.moveaxis(np.asarray(a), 0, -1) for a in vector]
    return np.concatenate([*rows, *(np.asarray(a)[..., None] for a in rest)], axis=-1)


@pytest.fixture(scope="module", params=CASES)
def case(request):
    """A system, a path through it that is not a ray, and the differentiated arguments."""
    stop, dim, tilted = CASES[request.param]
    system = system_with(stop, dim, tilted)
    hits = rough_path(system, RAYS)
    return system, hits, answers(system, hits, ALL, *given(hits))


@jax.jit
def less_the_first(hits, system):
    """Paths minus that of the first ray."""
    return fermat.optical_path(hits, system, tuple(h[..., :1] for h in hits))


@pytest.mark.parametrize("case", ["meridional", "tilted, active stop"], indirect=True)
def test_float32_holds_the_differences_of_long_paths(case):
    """Paths of 10 m, minus the first of them, compared with float64; if they are summed before they
    are subtracted, the error is 1e-3 mm."""
    system, hits, _ = case
    vertex = system.rows.vertex.at[1:].add(1e4)
    rows = system.rows._replace(vertex=vertex)
    system = dataclasses.replace(system, rows=rows)
    single = jax.tree.map(lambda a: a.astype(np.float32), (hits, system))
    again = jax.tree.map(lambda a: a.astype(float), single)  # the same numbers

    wanted = jax.jit(fermat.optical_path)(*again)
    found = less_the_first(*again)
    np.testing.assert_allclose(found, wanted - wanted[:, :1], rtol=0, atol=1e-11)
    assert np.max(np.abs(found)) > 0.1
    np.testing.assert_allclose(less_the_first(*single), found, rtol=0, atol=3e-6)


def test_residual_is_the_gradient_of_the_path(case):
    """Except for the components of the sensor, on which paths are not stationary."""
    _, _, all_of = case
    for ours, wanted in zip(all_of.equations[0], all_of.gradient, strict=True):
        np.testing.assert_allclose(ours, wanted[:-1], rtol=0, atol=4e-15)


def test_path_and_label_against_geometry(case):
    """Lengths are summed in NumPy, from the sphere about the object through the first vertex of the
    lens; the label is a point of the stop on the line through the hits on both sides."""
    system, hits, all_of = case
    path, (_, label) = all_of.path, all_of.equations
    points, source = corners(system, hits)
    whole = np.concatenate([np.broadcast_to(source, points[:1].shape), points])
    lengths = np.linalg.norm(np.diff(whole, axis=0), axis=-1)
    lengths[0] -= np.linalg.norm(source)
    np.testing.assert_allclose(path, np.sum(system.index * lengths, axis=0), atol=1e-12)
    if system.stop is None:
        np.testing.assert_array_equal(label, [h[system.before] for h in hits])
        return
    crossing = on_surface(system.stop, system.stop_form, wide(label))
    one, other = whole[system.before], whole[system.before + 1]
    along = (other - one) / np.linalg.norm(other - one, axis=-1, keepdims=True)
    np.testing.assert_allclose(np.cross(crossing - other, along), 0, atol=1e-12)


def test_linear_solves_the_dense_jacobian_and_its_transpose(case):
    """For random forces; and <y, A^-1 x> = <A^-T y, x>."""
    _, hits, all_of = case
    dense = np.moveaxis(flat_columns(all_of.columns), 0, -1)  # (W, Q, equations, unknowns)
    forces, shift, other = given(hits)
    value, pulled = all_of.solved, all_of.pulled
    wanted = np.linalg.solve(dense, flat(forces, shift)[..., None])[..., 0]
    size = np.max(np.abs(wanted))
    np.testing.assert_allclose(flat(value), wanted, atol=1e-12 * size)
    wanted = np.linalg.solve(np.swapaxes(dense, -1, -2), flat(other)[..., None])[..., 0]
    size = np.max(np.abs(wanted))
    np.testing.assert_allclose(flat(*pulled), wanted, atol=1e-12 * size)
    left = sum(np.vdot(a, b) for a, b in zip(other, value, strict=True))
    right = sum(np.vdot(a, b) for a, b in zip(jax.tree.leaves(pulled), (*forces, *shift)))
    np.testing.assert_allclose(left, right, rtol=1e-11)


def flat_columns(columns):
    """(columns, W, Q, equations) of the Jacobian."""
    forces, shift = columns
    return np.stack(
        [flat([f[i] for f in forces], [s[i] for s in shift]) for i in range(len(shift[0]))]
    )


def test_nothing_is_asked_of_the_distance_to_the_stop():
    """With the stop on a surface, in front of and behind it, the path and the solution are the same
    except for the motion of the stop. A path whose hits are all at one point stays finite if its
    rays are left out."""
    system = system_with("in front", 2, True)
    hits = rough_path(system, RAYS)
    moves = []
    for gap in (-1e-6, 0.0, 1e-6):
        vertex = system.rows.vertex[0] - gap
        placed = system.stop._replace(vertex=vertex, rotation=system.rows.rotation[0])
        near = dataclasses.replace(system, stop=placed)
        moves.append(np.stack(answers(near, hits, ALL, *given(hits)).solved))
    assert np.all(np.isfinite(moves))
    step = np.max(np.abs(np.diff(moves, axis=0)))
    assert 0 < step < 1e-5 * np.max(np.abs(moves[0]))


def test_rays_of_no_interest_come_out_finite():
    """All hits at one point, in planes without distance: the segments have no length and no
    direction."""
    system = system_with("between", 2)
    rows, stop = (jax.tree.map(jnp.zeros_like, a) for a in (system.rows, system.stop))
    system = dataclasses.replace(system, rows=rows, stop=stop)
    hits = tuple(jnp.zeros_like(h) for h in rough_path(system, RAYS))
    all_of = answers(system, hits, ~ALL, *given(hits))
    assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves((all_of.solved, all_of.pulled)))


def test_first_segment_is_continuous_to_infinity():
    system = system_with("between", 2, False, np.inf)
    hits = rough_path(system, RAYS)
    far = answers(system, hits, ALL, *given(hits))
    previous = None
    for distance in (1e4, 1e6, 1e9):
        nearer = dataclasses.replace(system, vergence=jnp.asarray(1 / distance, float))
        near = answers(nearer, hits, ALL, *given(hits))
        change = np.max(np.abs(np.subtract(near.equations[0], far.equations[0])))
        assert change < 30 / distance and np.max(np.abs(near.path - far.path)) < 400 / distance
        assert previous is None or change < previous / 50
        previous = change


@jax.jit
def stationary(hits, system, target):
    return fermat.stationary(fermat.geometry(hits, system), system, target)


def test_only_rays_are_stationary():
    system = meridional(load_lens("singlet"), [0.6, 0.5])
    target = (jnp.zeros((2, 1)),)
    on_axis = jnp.zeros((3, 2, 1))
    assert np.all(stationary((on_axis,), system, target))
    assert not np.any(stationary((on_axis,), system, (target[0] + 1e-9,)))  # another stop point
    outside = on_axis.at[0].set(60.0)  # the radius of the first surface is 51.68
    assert not np.any(stationary((outside,), system, target))
    elsewhere = on_axis.at[2].set(1.0)
    assert not np.any(stationary((elsewhere,), system, target))
    # 60 degrees inside the glass at the plane exit face: beyond the critical angle
    steep = on_axis.at[1].set(4.0 * np.tan(np.pi / 3))
    assert not np.any(stationary((steep,), system, target))


def test_arrival_is_the_last_segment():
    """Along the axes of the lens, with a tilted sensor."""
    system = system_with("active", 2, True)
    hits = rough_path(system, RAYS)
    points, _ = corners(system, hits)
    step = points[-1] - points[-2]
    ours = np.moveaxis(np.stack(jax.jit(fermat.arrival)(hits, system)), 0, -1)
    np.testing.assert_allclose(ours, step / np.sqrt(np.sum(step**2, -1, keepdims=True)), atol=1e-14)
    np.testing.assert_allclose(dot(ours.T, ours.T), 1, rtol=1e-14)
    assert DISTANCE * float(system.vergence) == 1
