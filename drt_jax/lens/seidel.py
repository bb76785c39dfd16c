"""Third-order aberrations: Seidel sums and paraxial colour of a rotationally symmetric lens.

Source of the formulas: Welford, Aberrations of Optical Systems (1986), ch. 8, 10.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import known_values, safe_divide
from .forms import FORMS, Point, Shape
from .lens import Lens
from .paraxial import (
    ParaxialRay,
    ParaxialSystem,
    chief_ray,
    marginal_ray,
    paraxial_system,
    petzval_parts,
    trace_ray,
)
from .scene import Scene, checked_scene, over_points
from .surface import by_form, profile, surface_sag


class ThirdOrder(NamedTuple):
    """Third-order aberrations at the paraxial image: the contribution of each surface.

    They are transverse aberrations of the ray from the edge of the field through the rim of the
    stop. The signs are those of CODE V's SA, TCO, TAS, SAS, PTB, DST, AX, LAT, PTZ.

    spherical: (S, W), mm.
    tangential_coma: (S, W), mm.
    tangential_astigmatism, sagittal_astigmatism: (S, W), blur of the tangential and of the sagittal
        image in the paraxial image plane, mm.
    petzval_blur: (S, W), mm.
    distortion: (S, W), mm.
    axial_colour, lateral_colour: (S, W), between the shortest and the longest wavelength, mm.
    petzval_curvature: (S, W), 1/mm.
    """

    spherical: Array
    tangential_coma: Array
    tangential_astigmatism: Array
    sagittal_astigmatism: Array
    petzval_blur: Array
    distortion: Array
    axial_colour: Array
    lateral_colour: Array
    petzval_curvature: Array

    @property
    def total(self) -> "ThirdOrder":
        """The sums over the surfaces, each (W,)."""
        return ThirdOrder(*(jnp.sum(part, axis=0) for part in self))


def _fourth_order(lens: Lens, vertex: Array) -> Array:
    """Coefficient (S,) of r^4 in the sag, less that of the sphere of curvature `vertex` (S,),
    mm^-3.
    """

    def quartic(y: Point, shape: Shape, form: str) -> Array:
        """The coefficient: for an asphere half the second derivative by r^2, which costs less to
        trace, else a 24th of the fourth by r."""
        if form == "asphere":
            return profile(y, shape)[2] / 2
        height = lambda y: surface_sag((y,), shape, form)  # noqa: E731
        for _ in range(4):
            height = slope_of(height)
        return height(y[0]) / 24

    def slope_of(f):
        return lambda y: jax.jvp(f, (y,), (jnp.ones_like(y),))[1]

    axis = (jnp.zeros_like(lens.curvature),)
    return by_form(quartic, axis, lens.shape, lens.forms)[:-1] - vertex**3 / 8


def _seidel(
    system: ParaxialSystem, figure: Array, marginal: ParaxialRay, chief: ParaxialRay
) -> tuple[Array, Array, Array, Array, Array]:
    """Seidel's five terms (S, W), mm.

    With the refraction invariants A = n (y c + u) of the marginal ray and B of the chief ray, the
    Lagrange invariant H and the change D(u/n) at the surface, they are S1 = -A^2 y D(u/n), S2 = -A
    B y D(u/n), S3 = -B^2 y D(u/n), S4 = -H^2 c D(1/n), and S5, plus the terms of the aspheric part
    of the sag.

    figure: (S,), see `_fourth_order`.
    """
    n, c = system.index, system.curvature[:, None]
    y, chief_y = marginal.height, chief.height
    a, chief_a = n[:-1] * (y * c + marginal.before), n[:-1] * (chief_y * c + chief.before)
    bend = y * (marginal.behind / n[1:] - marginal.before / n[:-1])
    invariant = n[0] * (chief.before[0] * y[0] - marginal.before[0] * chief_y[0])
    aspheric = 8 * figure[:, None] * (n[1:] - n[:-1])
    # Welford's S5, written without the quotient B / A, in which A may be 0.
    change, step = 1 / n[1:] - 1 / n[:-1], 1 / n[1:] ** 2 - 1 / n[:-1] ** 2
    s5 = chief_y * chief_a * c * change * (2 * y * chief_a - chief_y * a) - chief_a**3 * y * step
    return (
        -(a**2) * bend + aspheric * y**4,
        -a * chief_a * bend + aspheric * y**3 * chief_y,
        -(chief_a**2) * bend + aspheric * y**2 * chief_y**2,
        (invariant**2)[None] * petzval_parts(system),
        s5 + aspheric * y * chief_y**3,
    )


def third_order(lens: Lens, scene: Scene) -> ThirdOrder:
    """Third-order aberrations of each surface; `.total` adds them up.

    Conics and the r^2 and r^4 terms of aspheres are included. The theory does not cover odd powers
    of r, which are neglected. Transverse aberrations are 0 for an image at infinity, and colour is
    0 for one wavelength.

    lens: the lens.
    scene: the edge of the field, along y, and wavelengths.

    ValueError for a surface that diffracts, has no rotational symmetry or is tilted or decentred,
    and as in `paraxial`. Inside a trace, where tilts are not known, a tilted lens has infinite
    aberrations.
    """
    others = sorted({form for form in lens.forms if FORMS[form].symmetry != "rotational"})
    require(not others, f"third order: no theory for surfaces of the form {', '.join(others)}")
    require(lens.phase is None, "third order: no theory for diffractive surfaces")
    moves = lens.decentre, lens.tilt, lens.elements and (lens.elements.shift, lens.elements.tilt)
    moved = any(np.any(move) for move in jax.tree.leaves(known_values(moves)))
    remedy = "set lens.tilt, lens.decentre and lens.elements to None for the lens without them"
    require(not moved, f"third order: no theory for tilted or decentred surfaces; {remedy}")
    across = known_values(scene.field)
    if across is not None and np.any(np.asarray(across)[..., 0]):
        raise ValueError("field: third order: give an angle along y, for x and y their diagonal")
    return over_points(lambda point: _third_order(lens, point), checked_scene(lens, scene))


def _third_order(lens: Lens, scene: Scene) -> ThirdOrder:
    """`third_order` of one object point; infinite if the lens is tilted or the field not along y.

    With h = 1 / (2 n' u') of the marginal ray at the image, the Seidel sums give the transverse
    aberrations h S1, 3 h S2, h (3 S3 + S4), h (S3 + S4), h S4 and h S5. The colour of a surface is
    2 h A y D(dn / n), with the invariant A of the marginal ray (axial) or B of the chief ray
    (lateral), and dn between the shortest and the longest wavelength.
    """
    moves = lens.decentre, lens.tilt, lens.elements and (lens.elements.shift, lens.elements.tilt)
    system, vergence = paraxial_system(lens, scene.wavelengths), scene.vergence
    bent = jnp.any(jnp.array([jnp.any(move != 0) for move in jax.tree.leaves(moves)], bool))
    bent = bent | (scene.field[0] != 0)
    n, c = system.index, system.curvature[:, None]
    marginal = marginal_ray(system, vergence)
    height, slope = chief_ray(system, front=True)
    # Scaled to the field: the slope of the line from the object point to the first vertex.
    scale = safe_divide(scene.tangent[1], slope - vergence * height)
    chief = trace_ray(system, height * scale, slope * scale)
    figure = _fourth_order(lens, system.curvature)
    s1, s2, s3, s4, s5 = _seidel(system, figure, marginal, chief)

    colours = scene.wavelengths
    spread = (n[:, jnp.argmin(colours)] - n[:, jnp.argmax(colours)])[:, None] / n
    colour = n[:-1] * marginal.height * (spread[1:] - spread[:-1])
    half = safe_divide(jnp.ones_like(n[-1]), 2 * n[-1] * marginal.behind[-1])[None]
    found = ThirdOrder(
        spherical=half * s1,
        tangential_coma=3 * half * s2,
        tangential_astigmatism=half * (3 * s3 + s4),
        sagittal_astigmatism=half * (s3 + s4),
        petzval_blur=half * s4,
        distortion=half * s5,
        axial_colour=2 * half * colour * (marginal.height * c + marginal.before),
        lateral_colour=2 * half * colour * (chief.height * c + chief.before),
        petzval_curvature=-n[-1:] * petzval_parts(system),
    )
    return system.masked(found, scene.possible & ~bent)
