"""Names for the array types that recur in signatures. Shapes are checked in tests (jaxtyping with beartype).

`ArrayLike` and `DTypeLike` are those of `jax.typing` under their names: signatures in help texts would spell out their
members otherwise.
"""

import jax.typing
from jaxtyping import Array as Array
from jaxtyping import Bool as Bool
from jaxtyping import Float as Float
from typing_extensions import TypeAliasType

ArrayLike = TypeAliasType("ArrayLike", jax.typing.ArrayLike)
DTypeLike = TypeAliasType("DTypeLike", jax.typing.DTypeLike)
Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Directions = Float[Array, "*batch 3"]
Coefficients = Float[Array, "*batch n"]
Rotation = Float[Array, "3 3"]
