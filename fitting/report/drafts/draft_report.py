"""A first experiment: its files, and what it assumes as text for the terminal."""

from fitting.report import terrain_report
from fitting.report.formatting import aligned, bullets, joined
from fitting.report.goodness import goodness_tables
from fitting.runtime import files
from fitting.studies.drafts.draft import Draft, Ground

from . import experiment_text

AS_IT_COMES = "{} as it comes, for this body, without any fit:"
NOTHING_FREE = "free: nothing; a fit writes these parameters and judges them, in seconds"
MARGIN = 2.0  # m of ground around the stances, over which a foot may swing


def write_ground(ground: Ground) -> None:
    """Writes ground that was reconstructed, with its numbers and a picture."""
    terrain_report.write(ground.mesh, ground.terrain, ground.clip, MARGIN)


def write(draft: Draft) -> None:
    """Writes the experiment."""
    files.write_text(draft.experiment.path, experiment_text.as_toml(draft))


def text(draft: Draft) -> str:
    """What is assumed of each clip, what would be better, and what is free."""
    parts = []
    for entry, assumptions in zip(draft.experiment.clips, draft.assumptions, strict=True):
        rows = [["assumed", "from the clip", "what to check or improve"]]
        rows += [[topic, said, advice] for topic, said, advice in assumptions]
        parts += [entry.reference.name, aligned(rows), ""]
    parts += [bullets(list(draft.check.lines)), ""] if draft.check.lines else []
    parts += [AS_IT_COMES.format(draft.experiment.preset)]
    parts += [aligned(goodness_tables.distances_of_preset(draft.distances)), ""]
    free = [forecast.name for forecast in draft.forecasts if forecast.is_free]
    if free:
        parts.append(f"free: {len(free)} of {len(draft.forecasts)} parameters: {', '.join(free)}")
    else:
        parts.append(NOTHING_FREE)
    if draft.experiment.preset == "record" and not draft.experiment.record_only:
        parts.append(
            "what is fitted has more than the game's record holds; for that: --record-only"
        )
    return joined(parts)
