"""A few flagged rays of a bundle in its many lanes: each is tried several times at once."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import Array


class Lanes:
    """The lanes of a bundle (W, Q), given to the first K of its flagged rays, N lanes to each: the
    first N to the first of them. K = Q // N; lanes that are left over repeat the last.

    flagged: (W, Q), bool. each: N, at most Q.
    served: (W, Q), bool, the rays that have lanes.
    """

    def __init__(self, flagged: Array, each: int):
        self.each, self.few = each, flagged.shape[1] // each
        self._rank = jnp.cumsum(flagged, axis=-1, dtype=jnp.int32) - 1
        self.served = flagged & (self._rank < self.few)

    def of_rays(self, tree: Any) -> Any:
        """Of arrays (W, Q) what belongs to the rays that are served, (W, K); where fewer than K
        are flagged, that of the last ray of the bundle."""
        count = self.served.shape[1]
        order = jnp.where(self.served, count - jnp.arange(count, dtype=jnp.int32), 0)
        rays = count - jax.lax.top_k(order, self.few)[0]
        return jax.tree.map(lambda a: jnp.take_along_axis(a, rays, 1, mode="clip"), tree)

    def spread(self, tree: Any) -> Any:
        """Arrays (W, K, N), or (W, K, 1) of what is the same in all lanes of a ray, as (W, Q)."""
        waves, rays = self.served.shape

        def wide(a: Array) -> Array:
            a = jnp.broadcast_to(a, (waves, self.few, self.each)).reshape(waves, -1)
            return jnp.pad(a, ((0, 0), (0, rays - a.shape[1])), mode="edge")

        return jax.tree.map(wide, tree)

    def best(self, worth: Array) -> tuple[Array, Array]:
        """The first lane (W, Q), int32, of those of each ray with the highest `worth` (W, Q), and
        whether the ray is served and that is above 0."""
        own = worth[:, : self.few * self.each].reshape(len(worth), self.few, self.each)
        slot = jnp.clip(self._rank, 0, self.few - 1)
        lane = jnp.take_along_axis(jnp.argmax(own, axis=-1).astype(jnp.int32), slot, axis=-1)
        found = jnp.take_along_axis(jnp.any(own > 0, axis=-1), slot, axis=-1)
        return slot * self.each + lane, found & self.served
