"""Small numerical helpers that every stage shares."""

import jax.numpy as jnp

from shisd._typing import Array, Float


def normalize(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Unit vectors along `vectors`, without overflow or underflow at any scale; a zero vector gives NaN."""
    scaled = vectors / jnp.max(jnp.abs(vectors), axis=-1, keepdims=True)
    return scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=-1, keepdims=True))
