"""What foot IK acts on: skeletons and legs, the terrain, and the frame of animation.

Plain data (structs of arrays) and what follows from it directly: forward kinematics, and the first
hits of parallel rays. Nothing here decides anything; that is the work of `jaxik.stages`. It is no
physics engine either: rays run along -up only, and nothing else collides. Start with `skeleton`
(`Transform`, `LegPose`, `Rig`), then `terrain`, then `frame`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
