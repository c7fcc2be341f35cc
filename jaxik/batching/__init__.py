"""Many characters at once, side by side in a processor's vector lanes."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
