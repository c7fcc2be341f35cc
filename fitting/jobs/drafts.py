"""The job that makes a first experiment of one's own clips."""

from pathlib import Path

from fitting.experiments.experiment import Experiment
from fitting.report import terrain_report
from fitting.report.drafts import draft_report
from fitting.report.formatting import joined
from fitting.runtime import activity
from fitting.runtime.precision import in_float64
from fitting.studies.drafts.draft import (
    EXPERIMENT,
    DraftRequest,
    check_request,
    draft,
    reconstruct_grounds,
)

from .output import Log, output_folder, silent


@in_float64
def init(request: DraftRequest, output: str | Path, *, log: Log = silent) -> Experiment:
    """Writes an experiment that runs as it is, with every key and what it means.

    Where clips come without ground, it is reconstructed from their stances; parameters are free
    that the clips should be able to determine. What is assumed, and what would be better, is
    logged.

    Args:
        request: the clips, and what there is besides.
        output: folder for the experiment and the grounds; it may hold other files.
        log: called with what the command line prints.

    Raises:
        ValueError: a file cannot be read, the folder holds an experiment or ground already, or
            there is nothing that these clips could determine.
    """
    folder = Path(output)
    check_request(request)
    if (folder / EXPERIMENT).exists():
        raise ValueError(f"{folder / EXPERIMENT}: is there already; name another folder")
    with activity.announced(f"Reading {len(request.clips)} clip(s)"):
        clips = request.load()
    with output_folder(folder):
        if not request.terrains:
            log("no --terrain: the ground is reconstructed from where the feet stand")
        grounds = reconstruct_grounds(request, clips, folder)
        meshes = [ground.mesh for ground in grounds if ground is not None]
        for mesh in meshes:
            terrain_report.check_new_files(mesh)
        try:
            with activity.announced("Writing and drawing the ground"):
                for ground in grounds:
                    if ground is not None:
                        draft_report.write_ground(ground)
            drafted = draft(request, clips, folder, grounds)
        except BaseException:  # also Ctrl-C: ground without an experiment is of no use
            for mesh in meshes:
                terrain_report.remove(mesh)
            raise
        draft_report.write(drafted)
        path = drafted.experiment.path
        ending = f"written to {path}; now: jaxik fit {path} -o RUN"
        log(joined(["", draft_report.text(drafted), "", ending]))
        return drafted.experiment
