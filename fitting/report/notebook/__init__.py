"""What notebooks show of experiments, fits, posteriors and comparisons: tables and one picture."""

from . import experiments as experiments
from . import results as results
