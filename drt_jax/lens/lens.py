"""The lens: a frozen pytree of arrays over surfaces."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.dtypes import canonicalize_dtype

from ..inputs import require
from ..numerics import Numbers, concrete, matmul, real_array, still
from .aperture import Apertures
from .elements import Elements, rotation_matrix
from .forms import Shape
from .glass import (
    Dispersion,
    Glass,
    nd_and_vd,
    refractive_index,
    with_media,
    with_models,
)
from .phase import Phase
from .surface import surface_sag


@dataclasses.dataclass(frozen=True, eq=False)
class Labels:
    """Names of a lens and of its media.

    Labels are equal if the same surfaces separate different media and if the same media are air.
    They are static in `jit`, so that a program is not compiled again for other names.

    name: name of the lens.
    glasses: names of the S + 1 media.
    """

    name: str
    glasses: tuple[str, ...]

    @functools.cached_property
    def structure(self) -> tuple[int, ...]:
        """The structure on which equality depends.

        It says whether the first medium is air, and has a number for each medium: 0 for the medium
        in front of the lens, -1 for air, and otherwise the number of the glass, which increases by
        one at each boundary.
        """
        found, last = [0], 0
        for before, name in itertools.pairwise(self.glasses):
            solid = name not in ("air", self.glasses[0])
            last += solid and name != before
            found.append(last if solid else -(name != self.glasses[0]))
        return (self.glasses[0] == "air", *found)

    @functools.cached_property
    def unnamed(self) -> "Labels":
        """Labels of the same structure with generic names."""
        air, *media = self.structure
        names = {0: "air" if air else "medium", -1: "air"}
        return Labels("", tuple(names.get(k, f"glass {k}") for k in media))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Labels) and self.structure == other.structure

    def __hash__(self) -> int:
        return hash(self.structure)


# What has no derivative by a whole lens, see `Lens`: an array at the stop, or arrays of a part.
HELD = {
    "semi_diameter": (),
    "dispersion": ("strength", "resonance", "schott", "ranges", "thermal"),
    "phase": ("order",),
}
_REMEDY = "; go back to the lens before, and if an optimiser decays weights, give it `movable`"


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, repr=False)
class Lens:
    """A lens of S surfaces. Every array over surfaces ends with a row for the sensor.

    All arrays are differentiable leaves of one floating dtype; `jax.grad` with respect to a lens
    returns a `Lens`. z runs along the axis from the first vertex. A part that is None costs
    nothing.

    The derivative by a whole lens is 0 for numbers that a designer does not vary: the dispersion
    constants of air and of glasses with a formula (nd and vd of model glasses do have derivatives),
    the semi-diameter of the stop, orders of diffraction, and the shapes of planes (see `curved`).
    Such a number has its derivative if it is requested by name: if the differentiated function
    inserts it with `dataclasses.replace(lens, semi_diameter=...)`, or if `free` names it. An array
    that is inserted inside of a program (`jit`) counts as requested there. The insertion changes
    the pytree structure of the lens. Where the new lens meets the old one, as in `jax.tree.map(f,
    before, after)` in a program, in the carry of `scan` or in the branches of `cond`, give both
    lenses the name in `free`, so that they have the same structure.

    curvature: (S + 1,), 1/mm.
    conic: (S + 1,), 0 for a sphere, -1 for a paraboloid.
    coefficients: (S + 1, K), of the form of the surface, see `forms`; of an asphere those of r^2,
        r^4, ... in mm^-1, mm^-3, ...
    thickness: (S - 1,), between neighbouring vertices, mm; negative behind an odd number of
        mirrors, and next to a dummy stop that lies out of order along z.
    semi_diameter: (S + 1,), clear aperture, mm, inf for none; at the stop, the semi-diameter of the
        stop.
    sensor: (), z of the sensor, mm.
    dispersion: of the S + 1 media, the first one in front of the lens. A medium that continues
        behind a surface keeps the constants of its first row.
    decentre: (S + 1, 2), x and y, mm, of each surface from its place on the axis; None if all are
        0.
    tilt: (S + 1, 3), about x, then the rotated y, then the rotated z, right-handed, radians; None
        if all are 0.
    phase: phases of diffractive surfaces; None without any.
    elements: groups of surfaces that move together; None without any.
    apertures: apertures other than the circles of `semi_diameter`, and obscurations; None without
        any.

    Static:
    stop: index of the stop surface.
    labels: names of the lens and of the S + 1 media.
    forms: a name in `forms.FORMS` for each of the S + 1 rows; empty if all are aspheres.
    mirrors: for each of the S surfaces, True if it reflects; empty for none.
    curved: rows that are not active but may be curved, S for the sensor. The other inactive rows
        are planes, whose derivatives by curvature, conic and coefficients are 0. `load_lens` lists
        the rows that a prescription curves.
    afocal: True if light leaves the lens collimated. Hits on the sensor are then angles: where they
        are in mm for other lenses, they are in mrad, see docs/analysis.md.
    free: those of "semi_diameter", "dispersion" and "phase" of which all numbers have derivatives.

    held: the arrays that JAX inserted without derivatives; an array that is replaced is another
        object. Not for use.
    """

    curvature: Array
    conic: Array
    coefficients: Array
    thickness: Array
    semi_diameter: Array
    sensor: Array
    dispersion: Dispersion
    decentre: Array | None = None
    tilt: Array | None = None
    phase: Phase | None = None
    elements: Elements | None = None
    apertures: Apertures | None = None
    stop: int = dataclasses.field(metadata={"static": True}, kw_only=True)
    labels: Labels = dataclasses.field(metadata={"static": True}, kw_only=True)
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True}, default=())
    mirrors: tuple[bool, ...] = dataclasses.field(metadata={"static": True}, default=())
    curved: tuple[int, ...] = dataclasses.field(metadata={"static": True}, default=())
    afocal: bool = dataclasses.field(metadata={"static": True}, default=False)
    free: tuple[str, ...] = dataclasses.field(metadata={"static": True}, default=())
    held: tuple = dataclasses.field(default=(), kw_only=True)

    def tree_flatten(self) -> tuple[list, tuple]:
        """For JAX: the leaves; and as auxiliary data the names of parts without derivatives, and
        the static fields.
        """

        def is_held(name: str) -> bool:
            array = getattr(self, name)
            return name not in self.free and (any(array is h for h in self.held) or concrete(array))

        leaves, static = _fields()
        rest = (frozenset(filter(is_held, HELD)), *(getattr(self, name) for name in static))
        return [getattr(self, name) for name in leaves], rest

    def tree_flatten_with_keys(self) -> tuple[list, tuple]:
        """For JAX: as `tree_flatten`, each leaf with its name."""
        leaves, rest = self.tree_flatten()
        names = map(jax.tree_util.GetAttrKey, _fields()[0])
        return [*zip(names, leaves, strict=True)], rest

    @classmethod
    def tree_unflatten(cls, rest: tuple, children: Sequence) -> "Lens":
        """For JAX: the lens of these leaves.

        Derivatives of held numbers are stopped here, where a transformation hands the lens to a
        function.
        """
        leaves, static = _fields()
        parts = dict(zip((*leaves, *static), (*children, *rest[1:]), strict=True))
        for name in rest[0]:
            whole = parts[name]
            if not concrete(whole):
                known = {leaf: still(getattr(whole, leaf)) for leaf in HELD[name]}
                parts[name] = dataclasses.replace(whole, **known) if known else _open(whole, parts)
        return cls(**parts, held=tuple(parts[name] for name in rest[0]))

    def __repr__(self) -> str:
        """A short description; it also works for a gradient and inside a trace."""
        what = f"{self.count} surfaces, stop: surface {self.stop}"
        sensor = self.sensor
        if concrete(sensor) and getattr(sensor, "shape", None) == ():
            what += f", sensor {float(sensor):.6g}"
        kind = getattr(self.curvature, "dtype", None)
        return f"Lens({self.name!r}: {what}{f', {kind}' if kind else ''})"

    def __post_init__(self) -> None:
        object.__setattr__(self, "forms", self.forms or ("asphere",) * (self.count + 1))
        object.__setattr__(self, "mirrors", self.mirrors or (False,) * self.count)
        if not concrete(self.curvature):  # a program does not depend on names
            object.__setattr__(self, "labels", self.labels.unnamed)

    @property
    def name(self) -> str:
        """Name of the lens; empty in a trace and in the result of a program."""
        return self.labels.name

    @property
    def glasses(self) -> tuple[str, ...]:
        """Names of the S + 1 media; "glass 1", ... in a trace and in the result of a program."""
        return self.labels.glasses

    @property
    def count(self) -> int:
        """Number of surfaces S, without the sensor."""
        return len(self.labels.glasses) - 1

    @property
    def active(self) -> tuple[int, ...]:
        """The surfaces that refract, reflect or diffract."""
        media, added = self.glasses, () if self.phase is None else self.phase.surfaces
        bends = (m or a != b for m, a, b in zip(self.mirrors, media, media[1:]))
        return tuple(i for i, does in enumerate(bends) if does or i in added)

    @property
    def vertices(self) -> Array:
        """z of the S vertices and of the sensor on the undisturbed axis, (S + 1,), mm; the first is
        0.
        """
        first = jnp.zeros_like(self.sensor)[None]
        return jnp.concatenate([first, jnp.cumsum(self.thickness), self.sensor[None]])

    @property
    def places(self) -> tuple[Array, Array | None, Array | None]:
        """Positions and rotations of the S vertices and of the sensor along the axes of the lens.

        Returns z (S + 1,), mm; x and y (S + 1, 2), mm, or None if they are 0; and rotations (S + 1,
        3, 3) from the axes of each surface to those of the lens, or None for no rotation.
        """
        across, rotation = self.decentre, None
        if self.tilt is not None:
            rotation = jax.vmap(rotation_matrix)(self.tilt)
        if self.elements is None:
            return self.vertices, across, rotation
        z = self.vertices[:, None]
        across = jnp.zeros((len(z), 2), z.dtype) if across is None else across
        if rotation is None:
            rotation = jnp.broadcast_to(jnp.eye(3, dtype=z.dtype), (len(z), 3, 3))
        point = jnp.concatenate([across, z], axis=1)
        point, rotation = self.elements.carry(self.vertices, point, rotation)
        return point[:, 2], point[:, :2], rotation

    @property
    def sensor_motion(self) -> Array | None:
        """Derivative of the vertex of the sensor by `sensor`, (3,), along the axes of the sensor.

        None stands for (0, 0, 1): where the sensor is not tilted, or where its place does not count
        (afocal lenses).
        """
        rotation = self.places[2]
        if rotation is None or self.afocal:
            return None

        def vertex(sensor: Array) -> Array:
            z, across, _ = dataclasses.replace(self, sensor=sensor).places
            across = jnp.zeros((len(z), 2), z.dtype) if across is None else across
            return jnp.append(across[-1], z[-1])

        step = jax.jvp(vertex, (self.sensor,), (jnp.ones_like(self.sensor),))[1]
        return matmul(step, rotation[-1])

    @property
    def shape(self) -> Shape:
        """Shape of the S + 1 rows; its coefficients are (K, S + 1)."""
        return Shape(self.curvature, self.conic, self.coefficients.T)

    @property
    def senses(self) -> np.ndarray:
        """Direction of the light in front of each surface and of the sensor, (S + 1,).

        It is 1 along the z axis of the surface, and -1 against it, after an odd number of mirrors.
        """
        return np.cumprod([1, *(-1 if mirror else 1 for mirror in self.mirrors)])

    def index(self, wavelengths: Numbers) -> Array:
        """Refractive index (S + 1, W) of every medium.

        wavelengths: one or (W,), um. ValueError as in `checked_wavelengths`.
        """
        return refractive_index(self.dispersion, self.checked_wavelengths(wavelengths))

    def checked_wavelengths(self, wavelengths: Numbers) -> Array:
        """Wavelengths as an array (W,), um.

        wavelengths: one or a list, um. ValueError for none, for another shape, and as in
            `check_wavelengths`.
        """
        found = real_array("wavelengths", wavelengths, self.curvature.dtype)
        found = found if found.ndim else found[None]
        is_list = found.ndim == 1 and found.size
        require(is_list, f"wavelengths: expected one or a list, got shape {found.shape}")
        self.check_wavelengths(wavelengths)
        return found

    def check_wavelengths(self, wavelengths: Numbers) -> None:
        """Raises ValueError for a wavelength outside the range of a medium.

        Inside a trace values are not known and nothing is checked: see `Dispersion.knows`.

        wavelengths: one or (W,), um.
        """
        ranges = self.dispersion.ranges
        if not concrete((wavelengths, ranges)):
            return
        # Rounded to the dtype of the lens: 0.7 is not beyond 0.7 in float32.
        values = np.ravel(np.asarray(wavelengths, ranges.dtype)).astype(float).tolist()
        known = np.asarray(ranges, float).tolist()
        for name, (low, high) in zip(self.glasses, known, strict=True):
            for value in values:
                if not low <= value <= high:
                    outside = f"wavelength {value:g} um is outside the range of {name}"
                    nm = f"; wavelengths are in um: {value / 1000:g}" if value > 100 else ""
                    raise ValueError(f"{outside}, {low:g} to {high:g} um{nm}")

    @functools.cached_property
    def _wrong(self) -> str:
        """What is wrong with the numbers, as far as they are known; empty if nothing is."""
        for path, leaf in jax.tree_util.tree_leaves_with_path(self):
            if concrete(leaf) and np.any(np.isnan(np.asarray(leaf))):
                return f"lens{jax.tree_util.keystr(path)}: expected numbers, got NaN{_REMEDY}"
        schott, strength = self.dispersion.schott, self.dispersion.strength
        if concrete((schott, strength)):
            vacuum = np.eye(1, schott.shape[1])
            odd = (np.asarray(schott) != vacuum).any(axis=1) | np.asarray(strength).any(axis=1)
            for i in np.flatnonzero(odd & (np.array(self.glasses) == "air")):
                return f"lens.dispersion: medium {i} is called air and has another index{_REMEDY}"
        return ""

    def check(self) -> None:
        """Raises ValueError, naming the array, for a lens whose arrays do not fit together.

        It checks the shapes given above and that there is only one floating dtype; and, as far as
        numbers are known, that there is no NaN, that media called air have the index of air, and
        that the stop has a finite size above 0. Works also in a trace, and takes some microseconds.
        """
        rows, terms = self.count + 1, np.shape(self.coefficients)[1:2] or (0,)
        shapes: dict[str, tuple] = dict.fromkeys(("curvature", "conic", "semi_diameter"), (rows,))
        shapes |= {"coefficients": (rows, *terms), "thickness": (rows - 2,), "sensor": ()}
        shapes |= {"decentre": (rows, 2), "tilt": (rows, 3)}
        dtype = getattr(self.curvature, "dtype", None)
        if dtype is None or not jnp.issubdtype(dtype, jnp.floating):
            raise ValueError(f"lens.curvature: expected a floating array, got {dtype}")
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is None and name in ("decentre", "tilt"):
                continue
            what, found = f"lens.{name}: expected", np.shape(array)
            if found != shape:
                raise ValueError(f"{what} shape {shape} for {self.count} surfaces, got {found}")
            kind = getattr(array, "dtype", dtype)
            if kind != dtype and len({*map(canonicalize_dtype, (kind, dtype))}) > 1:
                raise ValueError(f"{what} the dtype of curvature, {dtype}, got {kind}")
        for name, values in (("forms", self.forms), ("dispersion", self.dispersion.schott)):
            found = len(values)
            require(found == rows, f"lens.{name}: expected {rows} rows, got {found}")
        curved, free, stop, last = self.curved, self.free, self.stop, self.count - 1
        is_known = {*curved} <= {*range(rows)}
        require(is_known, f"lens.curved: expected rows 0 to {rows - 1}, got {curved}")
        require({*free} <= {*HELD}, f"lens.free: expected some of {', '.join(HELD)}, got {free}")
        require(0 <= stop <= last, f"lens.stop: expected 0 to {last}, got {stop}")
        if concrete(self.semi_diameter):
            semi = float(np.asarray(self.semi_diameter)[self.stop])
            what = f"lens.semi_diameter: that of the stop, surface {stop}, must be above 0 mm and"
            require(semi != 0 and np.isfinite(semi), f"{what} finite, got {semi:g}")
        require(not self._wrong, self._wrong)


@functools.cache
def _fields() -> tuple[list[str], list[str]]:
    """Names of the leaves of a lens, and of its static fields."""
    known = [field for field in dataclasses.fields(Lens) if field.name != "held"]
    static = [field.name for field in known if field.metadata.get("static")]
    return [field.name for field in known if field.name not in static], static


def _open(semi: Array, parts: dict[str, Any]) -> Array:
    """Semi-diameters of which all but that of the stop have derivatives. `jax.jacrev` of a function
    of several outputs puts a tuple in the place of an array: that is returned as it is."""
    if not isinstance(semi, Array):
        return semi
    rows = np.arange(semi.size).reshape(semi.shape) % len(parts["labels"].glasses)
    return jnp.where(rows == parts["stop"], still(semi), semi)


def movable(tree: Any) -> Any:
    """A mask for optimisers: a lens, or each lens in a tree of parameters, of truth values.

    False marks arrays that no rule of an optimiser, such as weight decay, may change: apertures,
    and the numbers without a derivative by the whole lens (see `Lens`). Anything that is not a lens
    is True.

    `optax.adamw(1e-3, mask=drt_jax.movable)` and `optax.lion(1e-3, mask=drt_jax.movable)` train a
    lens: air remains air, and infinite apertures remain infinite.
    """

    def one(lens: Any) -> Any:
        if not isinstance(lens, Lens):
            return True
        held = {leaf for name, leaves in HELD.items() if name not in lens.free for leaf in leaves}
        held |= {"semi_diameter", "apertures"} - {*lens.free}
        moves = lambda path, _: not held & {getattr(key, "name", None) for key in path}  # noqa: E731
        return jax.tree_util.tree_map_with_path(moves, lens)

    return jax.tree.map(one, tree, is_leaf=lambda part: isinstance(part, Lens))


def sag(lens: Lens, surface: int, x: Numbers, y: Numbers) -> Array:
    """Sag of a surface: its height above its vertex plane, mm, along its own axes.

    lens: the lens.
    surface: 0 to S - 1, or S for the sensor.
    x, y: mm, of shapes that broadcast.
    """
    x, y = jnp.broadcast_arrays(*(jnp.asarray(a, lens.curvature.dtype) for a in (x, y)))
    row = jax.tree.map(lambda a: a[..., surface], lens.shape)
    return surface_sag((x, y), row, lens.forms[surface])


def glass_rows(lens: Lens, surfaces: Sequence[int]) -> np.ndarray:
    """The media, bool (S + 1,), of the glasses that begin behind some surfaces.

    surfaces: numbers of surfaces; empty for all glasses. ValueError, which lists those that exist,
        for a surface behind which no glass begins.
    """
    media = lens.glasses
    possible = [i for i in range(lens.count) if media[i + 1] not in ("air", media[i])]
    rows = np.zeros(len(media), bool)
    for i in surfaces or possible:
        if i not in possible:
            some = ", ".join(map(str, possible)) or "none"
            raise ValueError(f"surfaces: no glass begins behind surface {i}; there are {some}")
        end = next((k for k in range(i + 1, len(media)) if media[k] != media[i + 1]), len(media))
        rows[i + 1 : end] = True
    return rows


def _renamed(lens: Lens, dispersion: Dispersion, glasses: Sequence[str]) -> Lens:
    """The lens with another dispersion and other names of media."""
    labels = Labels(lens.name, tuple(glasses))
    return dataclasses.replace(lens, dispersion=dispersion, labels=labels)


def with_glass(lens: Lens, glass: Glass, surfaces: Sequence[int] = ()) -> Lens:
    """Replaces glasses by another glass, such as one of `find_glass`, with its own constants.

    lens: the lens.
    glass: the new glass.
    surfaces: surfaces, from 0, behind which the replaced glasses begin; empty for all.

    ValueError as in `with_model_glass`, and for a glass of the name of a medium that it touches.
    """
    media, rows = lens.glasses, glass_rows(lens, surfaces)
    found = [glass.name if row else old for old, row in zip(media, rows)]
    for i in range(lens.count):
        if found[i] == found[i + 1] and media[i] != media[i + 1]:
            raise ValueError(f"glasses: {glass.name} on both sides of surface {i}; take another")
    return _renamed(lens, with_media(lens.dispersion, rows, Dispersion.of([glass])), found)


def with_model_glass(lens: Lens, surfaces: Sequence[int] = ()) -> Lens:
    """Replaces glasses by model glasses, whose nd and vd are leaves that can be varied.

    nd and nF - nC are kept. The rest of the dispersion changes by the error of a model glass, see
    docs/limits.md.

    lens: the lens.
    surfaces: surfaces, from 0, behind which the replaced glasses begin; empty for all.

    ValueError for a surface behind which no glass begins and, as far as numbers are known, for a
    glass without dispersion.
    """
    media, rows = lens.glasses, glass_rows(lens, surfaces)
    if concrete(lens.dispersion):
        abbe = np.asarray(nd_and_vd(lens.dispersion))[:, 1]
        for name in np.array(media)[rows & ~((abbe >= 10) & (abbe <= 120))]:
            raise ValueError(f"glasses: {name} has no vd of 10 to 120; leave its surface out")
    names = (f"model {name.removeprefix('model ')}" for name in media)
    glasses = [new if row else old for new, old, row in zip(names, media, rows)]
    return _renamed(lens, with_models(lens.dispersion, rows), glasses)
