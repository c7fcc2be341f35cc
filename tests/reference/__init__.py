"""Foot IK once more in plain NumPy float64: one character, one leg, one frame at a time.

An independent implementation of all five systems to compare `jaxik` with, written from the
description of the rules and not from the code that is tested, with if/else, loops, acos and atan2,
so that an error would have to be made twice to go unnoticed. Nothing here imports `jaxik`. Start
with `systems.record`.

Metres, radians, seconds, wxyz; suffixes _ws world, _ms model, _ls local. Model up is +Y, forward
+Z, left +X. `up` is that of the body; rays, effectors and feet of a leg use its own.
"""
