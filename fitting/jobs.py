"""Whole jobs, from files to a folder with results and a report: what the command line runs.

Each job checks everything the user gave before it computes anything, writes its results as soon as
they exist, and draws its report last. Without an `output` nothing is written. Progress,
and the lines and tables that the command line prints, go to watchers: `runtime.activity`.

Jobs compute in 64 bits, whatever JAX is set to, and leave that setting alone. Their arrays have 64
bits; a system that was made in 32 bits is used with its values there.

Each job stands with its study in `fitting.studies`; `view` and `view_run` stand in
`fitting.viewer`.
"""

from .studies.ablation import ablate as ablate
from .studies.animations import apply as apply
from .studies.animations import solve as solve
from .studies.calibrate.calibration import calibrate as calibrate
from .studies.calibrate.wrong_model import calibrate_wrong_model as calibrate_wrong_model
from .studies.comparison import compare as compare
from .studies.draft import init as init
from .studies.exports import export as export
from .studies.exports import export_blender_addon as export_blender_addon
from .studies.exports import export_code as export_code
from .studies.fit.fit_jobs import fit as fit
from .studies.many.fit_many import fit_many as fit_many
from .studies.population import population as population
from .studies.sample.sample_jobs import compare_runs as compare_runs
from .studies.sample.sample_jobs import sample as sample
from .studies.suite import run_suite as run_suite
from .studies.terrain_report import reconstruct_terrain as reconstruct_terrain
from .studies.translation import translate as translate
from .viewer.views import view as view
from .viewer.views import view_run as view_run
