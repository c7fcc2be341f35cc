"""The numbers behind foot IK: vectors, quaternions, decisions, smoothing, parameters.

Plain functions over arrays, and the two kinds of class that hold arrays: `struct` for data, and
`eqx.Module` for gates and for rules with parameters. Gradients are finite everywhere, also where a
formula divides by zero on paper; each docstring states the value and gradient at such points.
Nothing here knows about legs or ground, and this is not a general geometry library: a function is
here because a stage uses it. Start with `vec` and `quat`, which nearly every other module imports.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
