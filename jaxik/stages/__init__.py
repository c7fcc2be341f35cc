"""The thirteen stages of foot IK, one module each.

contact, root, warp, probe, target, lean, lock, separation, pelvis, effector, leg, foot run in this
order; fade runs after the pelvis and after the effector. A module defines its stage's abstract
rule, the rules that implement it, and what they remember and return. A rule decides one thing, from
what earlier stages return, whatever their rules. Start with `inputs`, what every rule reads, then
any stage. To write a rule, subclass the abstract rule of its stage.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
