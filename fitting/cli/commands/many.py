"""Commands whose work is shared out to many processes."""

import argparse

from fitting import jobs
from fitting.cli.terminal import show
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.record_files import restrict
from fitting.runtime import cache_folder

from . import status


def fit_many(options: argparse.Namespace) -> int:
    """Fits each clip of many experiments alone."""
    cache_folder.use_default()
    experiments = [load_experiment(path) for path in options.experiments]
    if options.record_only:
        experiments = [entry if entry.record_only else restrict(entry) for entry in experiments]
    fits = jobs.fit_many(
        experiments,
        options.output,
        seeds=options.seeds,
        together=options.together,
        report=options.reports,
        workers=options.workers,
        scheduler=options.scheduler,
        log=show,
    )
    return status.of_many(fits)
