from . import lanes as lanes
from . import primitives as primitives
