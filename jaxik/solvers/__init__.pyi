from . import aim as aim
from . import two_bone as two_bone
