"""Numbers and the data made of them: vectors, quaternions, decisions, smoothing, parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
