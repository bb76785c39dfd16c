"""The network, its data and its training. Optics are computed elsewhere.

Data: `load_patches`, `batches`. One blur for all patches, as in the paper: `make_imager`,
`make_step`. Object points anywhere in the field: `FieldImager`, `draw_points`, `make_field_step`.
The loss of both: `mean_error`. The best linear filter of a lens: `power_of`, `wiener`, `filtered`.
The loop: `fit`, `evaluate`.
"""

from ..image.depth import depth_moments as depth_moments, moments_model as moments_model
from ..image.kernel import gaussian_psf as gaussian_psf, separable_psf as separable_psf
from ..image.sensor import (
    convolve as convolve,
    convolve_each as convolve_each,
    noise_of as noise_of,
    sensor_layer as sensor_layer,
)
from ..image.wiener import (
    apply_filter as apply_filter,
    power_of as power_of,
    wiener as wiener,
)
from ..lens.lens import movable as movable
from .adam import adam as adam, apply_updates as apply_updates
from .data import (
    DataConfig as DataConfig,
    Patches as Patches,
    batches as batches,
    load_patches as load_patches,
)
from .error import mean_error as mean_error
from .field import (
    FieldImager as FieldImager,
    ObjectPoints as ObjectPoints,
    draw_points as draw_points,
    make_field_step as make_field_step,
)
from .network import (
    count_parameters as count_parameters,
    filtered as filtered,
    red_net as red_net,
)
from .train import (
    Camera as Camera,
    evaluate as evaluate,
    fit as fit,
    make_imager as make_imager,
    make_step as make_step,
)
