"""Fits the parameters of foot IK to captured motion, and says how sure it is."""

from .clips import Clip as Clip
from .clips import load_clip as load_clip
from .clips import save_clip as save_clip
from .experiment import Experiment as Experiment
from .experiment import load_experiment as load_experiment
from .scenes import load_terrain as load_terrain
from .study import Fit as Fit
from .study import fit as fit
from .study import sample as sample
