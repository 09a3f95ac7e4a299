"""Names for the array types that recur in signatures. Shapes are checked in tests (jaxtyping with beartype)."""

from jaxtyping import Array as Array
from jaxtyping import Float as Float

Scalar = Float[Array, ""]
Vector = Float[Array, "3"]
Directions = Float[Array, "*batch 3"]
Coefficients = Float[Array, "*batch n"]
Rotation = Float[Array, "3 3"]
