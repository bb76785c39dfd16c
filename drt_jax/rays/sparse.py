"""Packing of a few flagged rays into the lanes of a bundle, with several trials for each ray."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


class Lanes:
    """Assigns the Q lanes of each wavelength to its first K = Q // N flagged rays.

    Each of these rays gets N neighbouring lanes, in the order of the rays. Lanes that remain repeat
    the last one. A search of the width Q can thus try N first guesses for each of K missing rays at
    a time.

    flagged: (W, Q), bool, rays that need lanes.
    each: N, lanes for each ray, at most Q.
    few: K, number of rays that can have lanes.
    served: (W, Q), bool, rays that have lanes.
    """

    def __init__(self, flagged: Array, each: int):
        self.each, self.few = each, flagged.shape[1] // each
        self._rank = jnp.cumsum(flagged, axis=-1, dtype=jnp.int32) - 1
        self.served = flagged & (self._rank < self.few)

    def of_rays(self, tree: Any) -> Any:
        """Gathers the entries (W, K) of arrays (W, Q) that belong to the rays with lanes.

        If fewer than K rays are flagged, the entries of the last ray of the bundle fill the rest.
        """
        count = self.served.shape[1]
        order = jnp.where(self.served, count - jnp.arange(count, dtype=jnp.int32), 0)
        rays = count - jax.lax.top_k(order, self.few)[0]
        return jax.tree.map(lambda a: jnp.take_along_axis(a, rays, 1, mode="clip"), tree)

    def spread(self, tree: Any) -> Any:
        """Spreads arrays (W, K, N) over the lanes, (W, Q). An array (W, K, 1) is repeated in all N
        lanes of a ray.
        """
        waves, rays = self.served.shape

        def wide(a: Array) -> Array:
            a = jnp.broadcast_to(a, (waves, self.few, self.each)).reshape(waves, -1)
            return jnp.pad(a, ((0, 0), (0, rays - a.shape[1])), mode="edge")

        return jax.tree.map(wide, tree)

    def best(self, quality: Array) -> tuple[Array, Array]:
        """The best lane of each ray.

        quality: (W, Q), quality of the trial in each lane; 0 for a failed trial.

        Returns the first lane with the highest quality among the lanes of each ray, (W, Q), int32;
        and a mask (W, Q) of the rays that have lanes and in one of them a quality above 0.
        """
        own = quality[:, : self.few * self.each].reshape(len(quality), self.few, self.each)
        slot = jnp.clip(self._rank, 0, self.few - 1)
        lane = jnp.take_along_axis(jnp.argmax(own, axis=-1).astype(jnp.int32), slot, axis=-1)
        found = jnp.take_along_axis(jnp.any(own > 0, axis=-1), slot, axis=-1)
        return slot * self.each + lane, found & self.served
