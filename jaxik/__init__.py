"""Foot IK for animated characters as pure, jittable, differentiable JAX functions.

`jaxik` adapts the legs of an animation to uneven ground: a system (`FootIK`, made by `presets`)
takes a `Rig`, a terrain and a `Frame` of animation and returns a `Result` with the solved legs.
`step` computes one frame in a game loop, `run` a whole clip, and `lanes` many characters at once.
All numbers of a system are leaves of a pytree, so they can be fitted to data.

It does not read files, fit parameters or animate the upper body. For files and fits see `fitting`.

Start with `jaxik.presets`, then `jaxik.pipeline`; to write a rule of your own, `jaxik.stages`.
Names are imported on first use, so that `import jaxik` alone does not import JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
