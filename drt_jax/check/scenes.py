"""The scenes of `drt-jax check`.

Each function makes a scene and returns the call that is timed. The call returns an array (N,), in
the order and unit of the entry of the same name in `truth.TRUTHS`. Some programs are compiled
without optimisation, as those of `show` are: a user waits for them.
"""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, ONCE, jit
from ..design.optimum import optimise
from ..design.problem import Problem
from ..design.variables import Variables
from ..files.load import load_lens
from ..image.beam_psf import Sampling
from ..image.converged import psf_moments
from ..image.depth import moments_model
from ..image.kernel import gaussian_psf, separable_psf
from ..image.psf import psf
from ..image.sensor import convolve_each, sensor_layer
from ..image.transfer import transfer
from ..learn.network import red_net
from ..learn.train import Camera, make_imager, make_step
from ..lens.edit import with_paraxial_pupil
from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..lens.scene import Scene
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss
from ..rays.rays import trace_rays

Call = Callable[[], Array]
_LINES = (0.6563, 0.5876, 0.4861)  # C, d, F, um
# Curvature in 1/mm, thickness in mm and glass behind each surface of CODE V's Double Gauss.
_DOUBLE_GAUSS = (
    (0.01779284094091543, 8.75, "N-SSK2"),
    (0.006566600536925569, 0.5, "air"),
    (0.02653743294670983, 12.5, "N-SK2"),
    (0.0, 3.8, "F5"),
    (0.04126892878570084, 16.36944492653564, "air"),
    (0.0, 13.74795696388906, "air"),
    (-0.03523942654429074, 3.8, "F5"),
    (0.0, 11.0, "N-SK16"),
    (-0.02636750828657709, 0.5, "air"),
    (0.005636604951748545, 7.0, "N-SK16"),
    (-0.0125926458590576, 61.4875364179821 - 0.4002686453541377, "air"),
)
_SLOW = 1 / math.hypot(1, 100 - 1 / 400)  # numerical aperture of `_paraboloid`


def double_gauss() -> Lens:
    """The Double Gauss f/2 that CODE V has as a sample, behind a stop of the radius 25 mm."""
    stop = {"radius": "inf", "thickness": 10.0, "stop": True, "semi_diameter": 25.0}
    rows = [{"curvature": c, "thickness": t, "glass": g} for c, t, g in _DOUBLE_GAUSS]
    return load_lens({"surfaces": [stop, *rows]})


def _paraboloid() -> Lens:
    """A paraboloid f/50, which forms a perfect image of a star."""
    stop = {"radius": "inf", "thickness": 100.0, "stop": True, "semi_diameter": 1.0}
    mirror = {"radius": -200.0, "conic": -1, "mirror": True, "thickness": -100.0}
    return load_lens({"surfaces": [stop, mirror]})


def zemax_double_gauss() -> Lens:
    """The bundled Double Gauss as OpticStudio's figures have it: f/3, focused at infinity, rays not
    aimed at the stop and not clipped."""
    lens = load_lens("double_gauss")
    width = first_order(lens, math.inf, _LINES[1]).entrance_pupil.semi_diameter[0]
    wide = jnp.full_like(lens.semi_diameter, jnp.inf)
    wide = wide.at[lens.stop].set(lens.semi_diameter[lens.stop] * 33.33 / 2 / width)
    sensor = lens.vertices[-2] + 57.314537905
    return with_paraxial_pupil(
        dataclasses.replace(lens, semi_diameter=wide, sensor=sensor), _LINES[1]
    )


def _spot(lens: Lens, field: float) -> Array:
    """RMS spot radius of the d line, um."""
    found = psf_moments(lens, Scene.point(field, math.inf, _LINES[1]), Gauss(12, "bilateral"))
    return 1e3 * jnp.sqrt(jnp.trace(found.covariance[0]))


_spot_and_slopes = jit(jax.value_and_grad(_spot), LARGE)


def glass() -> Call:
    """Indices of N-SSK2, N-SK2, F5 and N-SK16, each at C, d and F."""
    lens = double_gauss()
    return lambda: lens.index(jnp.array(_LINES))[np.array([2, 4, 5, 9])].ravel()


def rays() -> Call:
    """Heights, mm, of the marginal ray on eleven surfaces, and of four rays on the sensor."""
    return _heights(double_gauss())


def single() -> Call:
    """`rays` in float32."""
    return _heights(jax.tree.map(lambda a: a.astype(jnp.float32), double_gauss()))


def _heights(lens: Lens) -> Call:
    scene, points = Scene.point(0.0, math.inf, _LINES[1]), [[0, y] for y in (1.0, 0.8, 0.6, 0.4)]

    def call() -> Array:
        y = trace_rays(lens, scene, points).points[0, :, 1:, 1]
        return jnp.concatenate([y[0, :-1], y[:, -1]])

    return call


def spots() -> Call:
    """RMS spot radii, um, at 0, 14/3, 28/3 and 14 degrees."""
    lens, fields = zemax_double_gauss(), np.radians(14 / 3 * np.arange(4))
    return lambda: jnp.stack([_spot_and_slopes(lens, field)[0] for field in fields])


def gradient() -> Call:
    """Change of the spot at 14 degrees, um, by 0.0001/mm of each curvature that is not zero, and by
    0.01 mm of each thickness."""
    lens, field = zemax_double_gauss(), np.radians(14.0)  # of the type that `spots` has
    curved = np.flatnonzero(np.asarray(lens.curvature))

    def call() -> Array:
        slopes = _spot_and_slopes(lens, field)[1]
        return jnp.concatenate([1e-4 * slopes.curvature[curved], 0.01 * slopes.thickness])

    return call


def kernel() -> Call:
    """Percent of the light of a star in pixels of 5 um, from the middle one outwards."""
    lens, scene = _paraboloid(), Scene.point(0.0, math.inf, 0.5)
    sampling = Sampling.of("waves", Gauss(8, "bilateral"), 128)
    run = jit(lambda lens: psf(lens, scene, 0.005, 21, sampling=sampling).kernel, ONCE)
    return lambda: 100 * run(lens)[0, 10, 10:]


def mtf() -> Call:
    """Contrast at 0.1, 0.25, 0.5, 0.75 and 0.9 of the limit frequency."""
    lens, scene = _paraboloid(), Scene.point(0.0, math.inf, 0.5)
    lines = np.array([0.1, 0.25, 0.5, 0.75, 0.9]) * 2 * _SLOW / 0.5e-3
    sampling = Sampling.of("waves", Gauss(8, "bilateral"), 128)
    run = jit(lambda lens: transfer(lens, scene, lines, sampling=sampling).mtf, ONCE)
    return lambda: run(lens)[0]


def clipped() -> Call:
    """Where two discs overlap: share of the light, and RMS width and height of the beam, mm."""
    front = {"radius": "inf", "semi_diameter": 1.0, "thickness": 20.0, "index": 1.5}
    stop = {"radius": "inf", "semi_diameter": 1.0, "stop": True}
    lens = load_lens({"surfaces": [front, stop], "sensor": 21.0})
    # In the glass 0.7 mm over 20 mm.
    scene = Scene.point(math.asin(1.5 * math.sin(math.atan(0.7 / 20))), math.inf, 0.55)

    run = jit(lambda lens: psf_moments(lens, scene, Clipped(10, "bilateral")), ONCE)

    def call() -> Array:
        found = run(lens)
        widths = jnp.sqrt(jnp.diagonal(found.covariance[0]))
        return jnp.concatenate([found.throughput, widths])

    return call


def designed() -> Call:
    """Conic constant, and distance to the sensor in mm, of the mirror f/2.5 that images a star to a
    point, from a sphere out of focus by 1 mm."""
    mirror = {"radius": -100.0, "mirror": True, "thickness": -49.0}
    lens = load_lens({"surfaces": [mirror | {"stop": True, "semi_diameter": 10.0}]})
    variables = Variables.from_lens(lens, ["conic", "sensor"])
    problem = Problem.from_variables(variables, ["spot"], Scene.radians([0.0]))

    def call() -> Array:
        best = optimise(problem).lens
        return jnp.stack([best.conic[0], best.sensor])

    return call


def chart(height: int, width: int) -> np.ndarray:
    """Two pictures with three colours, (2, height, width, 3), values from 0 to 1."""
    which, y, x, colour = np.indices((2, height, width, 3))
    return (1 + np.sin(0.7 * x * (1 + which) + 0.3 * y * (1 + colour) + 0.02 * x * y)) / 2


def sensor() -> Call:
    """Grey levels, of 255, of the first row of a chart that is blurred by Gaussian kernels, all at
    once and picture by picture."""
    offset = np.array([[0.0, 0.0], [0.002, 0.0], [0.0, -0.003]])
    spread = np.array([np.diag([3e-5, 2e-5]), np.diag([2e-5, 5e-5]), np.diag([1e-5, 1e-5])])
    scenes, key = jnp.asarray(chart(14, 20), jnp.float32), jax.random.key(0)
    several = gaussian_psf(offset, spread, 0.0044, 9)
    kernels = separable_psf(offset, spread, 0.0044, 9), several

    @jax.jit
    def blurred(scenes: Array) -> Array:
        images = [sensor_layer(scenes, kernel, 0.0, key) for kernel in kernels]
        images.append(convolve_each(scenes, jnp.stack([several, several])))
        return 255 * jnp.stack(images)[:, 1, 0, ::4].ravel()

    return lambda: blurred(scenes)


def network() -> list[dict[str, np.ndarray]]:
    """Weights of a RED-Net of two layers with four channels between them."""
    shapes = (3, 3, 3, 4), (3, 3, 4, 3)
    waves = [np.sin(1 + 2.3 * k + 1.7 * np.arange(math.prod(s))) for k, s in enumerate(shapes)]
    kernels = [0.2 * wave.reshape(shape) for wave, shape in zip(waves, shapes)]
    return [{"kernel": a, "bias": 0.01 * a[0, 0, 0]} for a in kernels]


def training() -> Call:
    """Loss, in grey levels of 255, of three steps of Adam on a network and on the place of the
    sensor, which is 0.1 mm out of the focus of a paraboloid f/12.5."""
    mirror = {"radius": -100.0, "conic": -1, "mirror": True, "thickness": -50.1}
    lens = load_lens({"surfaces": [mirror | {"stop": True, "semi_diameter": 2.0}]})
    star = Scene.point(0.0, math.inf, (0.6, 0.53, 0.48))
    values, blur = moments_model(lens, ("sensor",), star, 1e-9)
    imager = make_imager(blur, red_net(1, 4)[1], Camera(kernel=9))
    rates = {"optics": 0.02, "network": 1e-3}
    far = 1e9, 1e9  # mm; the blur is that of infinity
    init, step = make_step(imager, rates, far, seed=0)
    weights = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), network())
    scenes = np.round(255 * chart(24, 24)).astype(np.uint8)

    def call() -> Array:
        state, losses = init({"optics": values, "network": weights}), []
        for index in range(3):
            state, metrics = step(state, scenes, np.float32(0), np.int32(index))
            losses.append(255 * metrics["loss"])
        return jnp.stack(losses)

    return call
