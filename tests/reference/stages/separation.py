"""A distance between feet."""

from reference.stages.shifts import Feet as Feet
from reference.stages.shifts import separate as separate
