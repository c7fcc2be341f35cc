"""Batches for CPUs: `lanes`, which maps a function over a batch whose axis is last.

Side by side on the last axis, eight numbers of a batch fill a processor's vector register. `lanes`
knows nothing about foot IK: it works on any pure function of arrays. It does not spread work over
cores or devices. Start with `lanes`; `primitives` holds one rule per kind of JAX primitive.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
