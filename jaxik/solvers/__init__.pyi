from . import rotations as rotations
from . import two_bone as two_bone
