"""Methods that `jax.jit` takes as they are."""

from collections.abc import Callable
from typing import Any

import jax


class method:
    """A method of a module that, bound, has a hash: `jax.jit(basis.weights)`.

    Equinox binds methods as modules, whose hash is that of their arrays, and arrays have none. Bound here, a method is
    still a pytree of its module, so that Equinox's transformations see its arrays.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function

    def __get__(self, instance: Any, owner: Any = None) -> Callable[..., Any]:
        return self.function if instance is None else jax.tree_util.Partial(self.function, instance)
