from . import aim as aim
from . import pole as pole
from . import reach as reach
from . import rotations as rotations
from . import two_bone as two_bone
