"""Foot IK as pure, jittable JAX functions over batched legs.

What is named here is imported when it is first asked for: importing `jaxik` costs next to nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
