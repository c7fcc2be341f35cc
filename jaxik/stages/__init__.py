"""The stages of the pipeline, one module each, in the order in which they run."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
