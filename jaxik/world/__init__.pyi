from . import cells as cells
from . import frame as frame
from . import grid as grid
from . import skeleton as skeleton
from . import terrain as terrain
