"""Reference values of the scenes of `drt-jax check`, and their sources.

No number was computed by this package. Numbers of other programs are from their listings;
`tests/check/outside.py` computes the others again, without the package.
"""

from typing import NamedTuple


class Truth(NamedTuple):
    """Reference values of one scene.

    about: what is compared.
    source: origin of the values.
    values: the numbers, in `unit`.
    unit: of the values and of the error.
    allowed: largest error that is right.
    why: where the allowed error comes from.
    usual: ms of a further call on two cores of an AMD EPYC.
    """

    about: str
    source: str
    values: tuple[float, ...]
    unit: str
    allowed: float
    why: str
    usual: float


_CODE_V = "CODE V 10.8, ag_dblgauss.lis"
_STUDIO = "OpticStudio 26.1, double Gauss 28 degrees"
# Heights on the eleven surfaces; ray errors at 1, 0.8, 0.6 and 0.4 of the aperture.
_HEIGHTS = (
    25.0, 24.109772, 22.844992, 20.958242, 16.784894, 15.702464, 14.610682, 15.815163, 16.882946,
    16.583956, 16.261006, 0.014138, -0.012851, 0.007971, 0.022285,
)  # fmt: skip
_SENSOR = (
    141.8168389044, 147.6494269498, 94.04354862463, 135.7122046211, 141.9212621354, 107.5094027388,
    128.9705166078, 135.5680050102, 121.5916795498,
)  # fmt: skip

# Two scenes are compiled at once: `gradient` is last, so that the program of `spots` is there.
TRUTHS = {
    "glass": Truth(
        "indices of four glasses at C, d, F",
        _CODE_V,
        (1.618769, 1.622292, 1.630455, 1.604134, 1.607379, 1.614860,
         1.598744, 1.603417, 1.614617, 1.617271, 1.620408, 1.627559),
        "", 5.1e-7, "half a unit of the last digit printed", 1.5,
    ),
    "rays": Truth(
        "rays of a Double Gauss f/2, 11 surfaces",
        _CODE_V, _HEIGHTS, "mm", 5.1e-7, "half a unit of the last digit printed", 5,
    ),
    "spots": Truth(
        "RMS spots of a Double Gauss, 0 to 14 degrees",
        _STUDIO, (8.32008367775683, 6.79430502967547, 6.0760773668338048, 9.94984019755134),
        "um", 1e-8, "a hundredth of a picometre; rounding is 1e-11 um", 20,
    ),
    "single": Truth(
        "the same rays in float32",
        _CODE_V, _HEIGHTS, "mm", 1e-4, "a tenth of a micrometre: what float32 promises", 4,
    ),
    "kernel": Truth(
        "wave kernel of a star, 5 um pixels, f/50",
        "closed form: Airy's pattern",
        (3.090256279049, 2.800658169012, 2.063713848695, 1.192257914659, 0.493635630633,
         0.1131972418333, 0.005681977242041, 0.02657198249679, 0.05249605341175, 0.04175945157373,
         0.01494763603146),
        "% of light", 4e-4, "1e-4 of the peak: so even is the light of a paraboloid", 10,
    ),
    "mtf": Truth(
        "contrast at five frequencies, f/50",
        "closed form: a circle",
        (0.8728885715695383, 0.6850376424742927, 0.3910022189557706, 0.14429361281438743,
         0.037386073468498655),
        "", 2e-5, "the grid of 128 x 128 cells", 100,
    ),
    "clipped": Truth(
        "share, width and height of a clipped beam",
        "closed form: two discs that overlap",
        (0.5636394821727, 0.4425398893023, 0.3189165535348),
        "", 1e-10, "rounding, and a rule of order 10", 10,
    ),
    "designed": Truth(
        "a mirror that least squares make a paraboloid",
        "closed form: conic -1, focus 50 mm",
        (-1.0, -50.0), "mm", 1e-8, "where the search ends", 60,
    ),
    "sensor": Truth(
        "pictures blurred in three ways, float32",
        "SciPy: error function, convolution", _SENSOR * 3,
        "grey levels", 1e-3, "of 255: rounding of float32", 2,
    ),
    "training": Truth(
        "losses of three steps of sensor and network",
        "NumPy and SciPy: complex steps, Adam",
        (25.00456056613, 18.00442790559, 13.22853995448),
        "grey levels", 2e-2, "of 255: products of 10 bits, which a GPU takes; a CPU has 1e-5", 8,
    ),
    "gradient": Truth(
        "gradient of the spot by 20 numbers of that lens",
        "independent trace, complex step",
        (53.07710754846, -48.99878897992, 43.21544686724, -22.29573396415,
         14.16006380017, -17.80350446166, 20.86162793152, -18.77046221404,
         -0.8419092106538, -0.8423774308395, -0.1490952607506, -0.3558148480576, 1.909626858314,
         1.950179084085, -0.4211449751872, -0.4211449751872, -0.6858967491706, -0.6883229237897,
         -0.8388185419475, -0.7613701229006),
        "um", 1e-8, "a billionth of it: um for 0.0001/mm of a curvature, 0.01 mm of a gap", 5,
    ),
}  # fmt: skip
