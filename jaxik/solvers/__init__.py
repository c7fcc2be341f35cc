"""Closed-form solvers of limbs and joints, independent of any game's rules.

Rotations that bend a two-bone limb to its target (`two_bone`) and turn a joint towards one
(`rotations`), without iteration and with finite gradients also for straight, folded and unreachable
limbs. They know no frames, weights or ground, which are the business of `jaxik.stages`, and no
chains of more than two bones. Start with `two_bone`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
