"""Three short clips of different length, as an experiment."""

import tempfile
from pathlib import Path

from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from support.experiments import CLIP, write

LENGTHS = (0.5, 0.3, 0.6)  # s


def experiment() -> Experiment:
    """With sigmas that its posterior may leave open."""
    clips = "".join(f"{CLIP}start = 1.0\nend = {1.0 + length}\n" for length in LENGTHS)
    with tempfile.TemporaryDirectory() as folder:
        return load_experiment(write(Path(folder), top='loss = "squares"', clips=clips))
