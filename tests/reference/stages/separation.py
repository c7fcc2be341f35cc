"""A distance between feet."""

from reference.stages.steps import Feet as Feet
from reference.stages.steps import separate as separate
