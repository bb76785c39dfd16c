"""Functions that stay finite, with finite derivatives, where the plain ones do not.

Each is written with a double `where`: the dangerous operation only ever sees a harmless
argument, so neither its value nor its derivative can turn into NaN. Nothing is added to a
denominator, so ordinary values are not biased.
"""

import jax.numpy as jnp
from jax import Array

__all__ = ["safe_divide", "safe_sqrt"]


def safe_sqrt(x: Array) -> Array:
    """Square root of `x`; 0, with derivative 0, where `x` <= 0. Any shape, floating dtype."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_divide(numerator: Array, denominator: Array) -> Array:
    """`numerator / denominator`; 0, with derivative 0, where the denominator is 0.

    The arguments broadcast and share one floating dtype.
    """
    good = denominator != 0
    return jnp.where(good, numerator / jnp.where(good, denominator, 1), 0)
