from . import arguments as arguments
from . import cells as cells
from . import frame as frame
from . import grid as grid
from . import heightfield as heightfield
from . import skeleton as skeleton
from . import surfaces as surfaces
from . import terrain as terrain
