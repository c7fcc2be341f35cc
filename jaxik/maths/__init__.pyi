from . import gate as gate
from . import outline as outline
from . import parameter_tree as parameter_tree
from . import quat as quat
from . import smoothing as smoothing
from . import struct as struct
from . import vec as vec
