"""The pipeline: a system of thirteen rules, and how frames of animation go through it.

Everything here is for one character; batch with `jaxik.lanes` or `jax.vmap`. Start with
`system.FootIK`, then `phases.solve`, which is the whole algorithm.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
