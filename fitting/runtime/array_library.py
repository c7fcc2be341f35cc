"""Which library computes with arrays: JAX where a program is traced, NumPy for a few numbers."""

from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def library_of(*arrays: object) -> ModuleType:
    """JAX if any of these is traced, else NumPy, which takes no time to compile or to call."""
    return jnp if any(isinstance(array, Tracer) for array in arrays) else np
