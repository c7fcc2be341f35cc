"""Foot IK as pure, jittable JAX functions over batched legs."""

from . import presets as presets
from . import record as record
from .frame import Frame as Frame
from .gate import HARD as HARD
from .gate import Hard as Hard
from .gate import Smooth as Smooth
from .pipeline import FootIK as FootIK
from .pipeline import Result as Result
from .pipeline import State as State
from .pipeline import init as init
from .pipeline import resume as resume
from .pipeline import run as run
from .pipeline import step as step
from .skeleton import LegPose as LegPose
from .skeleton import Rig as Rig
from .skeleton import Transform as Transform
