"""The keys of an experiment file: what each may be, in words, as a test and as JSON Schema."""

from typing import get_args

from fitting.datasets.clips.footing.skating import TRAVELS
from fitting.datasets.ground_path import ROOTS
from fitting.experiments.systems import BODY
from fitting.inference.noise.settings import Correlation, Sigmas
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.sampling.settings import SamplerSettings
from fitting.inference.settings import Settings, describe
from fitting.problem.loss import Loss
from fitting.problem.scene import LEAST_SIGMAS, WHITENED
from fitting.runtime import validation
from fitting.runtime.validation import Constraint

FILES = {
    "reference": "The captured motion: a clip. Needed.",
    "terrain": "The ground under it: a mesh or a heightfield. Needed.",
    "base": "The flat animation; left out, it is made from the reference.",
    "truth": "Parameters that made a synthetic reference, for the report.",
    "tracks": "What changes along the clip: a track file.",
    "asf": "The skeleton of an .amc, where it is not beside it.",
}
FILE_KEYS = tuple(FILES)
AXIS = validation.one_of(("y", "z"))
UNITS = validation.number(1e-9, 1e6)
JOINTS = Constraint(
    "a file, or a table of joint names by role",
    lambda value: validation.TEXT.accepts(value) or validation.TABLE.accepts(value),
    {"anyOf": [validation.TEXT.schema, validation.TABLE.schema]},
)
OFFSET = Constraint(
    "three numbers of metres from -1e+06 to 1e+06",
    lambda value: (
        isinstance(value, list)
        and len(value) == 3
        and all(validation.is_within(entry, -1e6, 1e6) for entry in value)
    ),
    {
        "type": "array",
        "items": {"type": "number", "minimum": -1e6, "maximum": 1e6},
        "minItems": 3,
        "maxItems": 3,
    },
)
CLIP_KEYS: dict[str, Constraint] = {
    **{key: validation.TEXT.meaning(f"{doc} The path is relative.") for key, doc in FILES.items()},
    "label": validation.TEXT.meaning("What plots call the reference."),
    "subject": validation.TEXT.meaning("Whom the clip shows, for [hierarchy]."),
    "start": validation.SECONDS.meaning("Where the part of the clip that counts begins.", "s"),
    "end": validation.SECONDS.meaning("Where it ends; left out, with the clip.", "s"),
    "joints": JOINTS.meaning("Which joint of reference and base is which: a map of joints."),
    "scale": UNITS.meaning("Metres per unit of reference and base; left out, guessed."),
    "up": AXIS.meaning("Up axis of reference and base; left out, guessed."),
    "animation": validation.TEXT.meaning("Which animation of a .glb or .gltf that has several."),
    "travel": validation.one_of(TRAVELS).meaning(
        "Whether the roots of reference and base are moved so that standing feet stay put, or left,"
        " or moved where the clip is clearly a cycle in place; left out, auto."
    ),
    "sole": validation.number(0, 10, "metres").meaning(
        "Height of the balls of reference and base over their soles; left out, measured or"
        " estimated.",
        "m",
    ),
    "file_up": AXIS.meaning("Up axis of the terrain's file."),
    "terrain_scale": UNITS.meaning("Metres per unit of the terrain's file."),
    "terrain_offset": OFFSET.meaning("By which the terrain is moved.", "m"),
    "terrain_cell": validation.number(1e-3, 1e4, "metres").meaning(
        "Between two heights of a terrain whose file does not say it.", "m"
    ),
    "mask_pops": validation.BOOLEAN.meaning(
        "Whether frames in which a captured marker jumps are left out."
    ),
    "held_out": validation.BOOLEAN.meaning(
        "Whether the clip is not fitted, but shows what the fit is worth."
    ),
    "root": validation.one_of(ROOTS).meaning(
        "Where the root is put: where the animation has it, on the ground below it, or on the"
        " ground only where foot IK does not reach it."
    ),
}
DEVIATION = "Standard deviation of the residuals of"
SIGMAS = {  # by kind: meaning and unit
    "ankle": (f"{DEVIATION} ankle positions.", "m"),
    "knee": (f"{DEVIATION} knee positions.", "m"),
    "pelvis": (f"{DEVIATION} the pelvis's position.", "m"),
    "foot": (f"{DEVIATION} the rotation of the ankle joints.", "rad"),
    "body": (f"{DEVIATION} the rotation of the pelvis.", "rad"),
    "contact": (f"{DEVIATION} the weight of contact.", ""),
    "smooth": (f"{DEVIATION} the acceleration of the ankles, which should be 0.", "m/s²"),
}
KINDS = tuple(SIGMAS)
SIGMA_KEYS = {
    kind: validation.number(LEAST_SIGMAS.get(kind, 1e-9), 1e9, or_inf=True).meaning(
        f"{doc} Infinity leaves them out.", unit
    )
    for kind, (doc, unit) in SIGMAS.items()
}
CORRELATIONS = tuple(f"correlation.{kind}" for kind in WHITENED)  # instead of one for all
CORRELATION = validation.CORRELATION.meaning("Correlation of residuals from frame to frame.")
SIGMA_KEYS |= dict.fromkeys(("correlation", *CORRELATIONS), CORRELATION)


def _constraints(settings: type[Settings]) -> dict[str, Constraint]:
    return {
        name: Constraint(
            declared.range, lambda value, declared=declared: declared.allows(value), declared.schema
        ).meaning(declared.meaning, "" if declared.unit == "1" else declared.unit)
        for name, declared in describe(settings).items()
    }


FIT_KEYS: dict[str, Constraint] = {
    "starts": validation.count(1, 1000).meaning(
        "Independent starts of the search, at most, until enough of them agree."
    ),
    "max_steps": _constraints(SearchSettings)["max_steps"],
    "search": validation.TABLE.meaning("Settings of the search."),
}
SEARCH_KEYS = {
    name: constraint
    for name, constraint in _constraints(SearchSettings).items()
    if name != "max_steps"  # which is a key of [fit]
}
SAMPLE_KEYS = _constraints(SamplerSettings)
NOISE_KEYS = {
    "sigmas": validation.one_of(get_args(Sigmas)).meaning(
        "Whether the standard deviations are as [sigmas] says, or are estimated from there on,"
        " which moves the best point: right where a system can follow all but the noise."
    ),
    "correlation": validation.one_of(get_args(Correlation)).meaning(
        "Whether intervals are as wide as size and correlation of the residuals say (counted), or"
        " as [sigmas] says (given); or the correlation is taken out of the residuals (whitened),"
        " which moves the best point: right where a system can follow all but the noise."
    ),
}
TABLES = {
    "free": "What is fitted, if anything; {} takes range, kind and scale from the rule's"
    " declaration. Needed.",
    "capture": "What is not known of the captures and fitted beside the system, for each clip.",
    "prior": "What is known of free parameters before any clip.",
    "start": "Where the search begins; left out, at the system's values.",
    "rules": "Rules that differ from the preset's, by stage.",
    "parameters": "Fixed values that differ from the preset's.",
    "sigmas": "Standard deviation of each kind of residual.",
    "noise": "Which properties of the noise are estimated, and what for.",
    "fit": "How the best fit is searched for.",
    "sample": "How `jaxik sample` samples the posterior.",
    "hierarchy": "What several clips and subjects have in common; left out, everything.",
}
TOP_KEYS: dict[str, Constraint] = {
    "name": validation.TEXT.meaning("Title of the experiment; left out, the file's name."),
    "written_in": validation.TEXT.meaning(
        "Where the file was written: paths start there that lead nowhere from the file itself, as"
        " after moving a run alone."
    ),
    "preset": validation.TEXT.meaning("The system that is fitted."),
    "faithful": validation.BOOLEAN.meaning(
        "Whether the preset is the original, where the preset differs from it."
    ),
    "body": BODY.meaning(
        "Whose numbers and ranges are meant: those of the first clip's body, or of an adult of"
        " 1.8 m."
    ),
    "record_only": validation.BOOLEAN.meaning(
        "Whether free parameters that the game's record has no room for are left out."
    ),
    "loss": validation.one_of(get_args(Loss)).meaning(
        "How residuals count; all but squares give a few wrong frames less influence. Left out,"
        " huber; squares where sigmas are estimated."
    ),
    "fps": validation.RATE.meaning("Rate to which clips are resampled; left out, none.", "Hz"),
    "holdout": validation.number(0.0, 0.9).meaning(
        "Fraction of each clip, its end, that is not fitted but shows what the fit is worth; clips"
        " of less than 3 s are fitted whole."
    ),
    "seed": validation.SEED.meaning("Of all random numbers."),
    "independent_every": validation.SECONDS.meaning(
        "Time between residuals that count as independent; at 0 as [noise] says.", "s"
    ),
    **{name: validation.TABLE.meaning(doc) for name, doc in TABLES.items()},
    "clips": validation.list_of("[[clips]], one for each clip").meaning("The clips. Needed."),
    "without": validation.list_of("[[without]], one for each variant").meaning(
        "Variants that `jaxik ablate` fits."
    ),
}
