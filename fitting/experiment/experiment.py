"""An experiment: which parameters of which system are fitted to which clips."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp

import jaxik
from fitting.clips import Clip
from fitting.clips.load import ClipOptions
from fitting.clips.stances import contacts_path
from fitting.ground.ground_path import Root
from fitting.ground.meshes import TerrainOptions
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.solution import MAX_STARTS, SearchSettings
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.sensitivity import FreeTable
from fitting.problem.capture_system import with_capture
from fitting.problem.problem import Loss
from fitting.problem.scene import LEAST_SIGMAS, WHITENED
from fitting.problem.space import (
    FreeParameter,
    Priors,
    Space,
    check_inside,
    free_parameter,
    make_space,
)
from fitting.runtime import validation
from fitting.runtime.declarations import NEEDED, TABLE, Key, key, keys, number
from fitting.runtime.display import Displayable
from fitting.runtime.precision import with_floats
from jaxik.world import body
from jaxik.world.terrain import Terrain

from . import file_tables
from .file_tables import Ablation, Hierarchy
from .systems import DEFAULT_PRESET, OWN_ROOT, Body, Preset, with_parameters, with_rules

DEVIATION = "Standard deviation of the residuals of"
SIGMAS = {  # by kind: the error of a good fit of captured motion, meaning and unit
    "ankle": (0.02, f"{DEVIATION} ankle positions.", "m"),
    "knee": (0.03, f"{DEVIATION} knee positions.", "m"),
    "pelvis": (0.02, f"{DEVIATION} the pelvis's position.", "m"),
    "foot": (0.10, f"{DEVIATION} the rotation of the ankle joints.", "rad"),
    "body": (math.inf, f"{DEVIATION} the rotation of the pelvis.", "rad"),
    "contact": (math.inf, f"{DEVIATION} the weight of contact.", ""),
    "smooth": (
        math.inf, f"{DEVIATION} the acceleration of the ankles, which should be 0.", "m/s²"
    ),
}  # fmt: skip
SIGMA_KEYS = {
    kind: Key(
        number(LEAST_SIGMAS.get(kind, 1e-9), 1e9, or_inf=True),
        f"{meaning} Infinity leaves them out.",
        unit,
        default,
    )
    for kind, (default, meaning, unit) in SIGMAS.items()
} | {"correlation": Key(number(0, 0.999), "Correlation of residuals from frame to frame.", "", 0.0)}
CORRELATION = SIGMA_KEYS["correlation"]._replace(default=None)
OWN_CORRELATIONS = {f"correlation.{kind}": CORRELATION for kind in WHITENED}  # not one for all
ALL_SIGMA_KEYS = SIGMA_KEYS | OWN_CORRELATIONS
DEFAULT_SIGMAS = {kind: declared.default for kind, declared in SIGMA_KEYS.items()}


class LoadedFiles(NamedTuple):
    """The files of a clip, in memory."""

    reference: Clip
    terrain: Terrain
    base: Clip | None = None


@dataclass(frozen=True)
class ClipEntry(TerrainOptions, ClipOptions):
    """One clip of an experiment."""

    reference: Path = key(NEEDED, "The captured motion: a clip.")
    terrain: Path = key(NEEDED, "The ground under it: a mesh or a heightfield.")
    base: Path | None = key(None, "The flat animation; left out, it is made from the reference.")
    truth: Path | None = key(None, "Parameters that made a synthetic reference, for the report.")
    start: float = key(0.0, "Where the part of the clip that counts begins.", "s", 0, 1e6)
    end: float | None = key(None, "Where it ends; left out, with the clip.", "s", 0, 1e6)
    label: str = key("captured", "What plots call the reference.")
    mask_pops: bool = key(True, "Whether frames in which a captured marker jumps are left out.")
    held_out: bool = key(False, "Whether the clip is not fitted, but tests the fit.")
    root: Root = key(
        "auto",
        "Where the root is put: where the animation has it, on the ground below it, or on the"
        " ground only where foot IK does not reach it.",
    )
    tracks: Path | None = key(None, "What changes along the clip: a track file.")
    subject: str | None = key(None, "Whom the clip shows, for [hierarchy].")
    loaded: LoadedFiles | None = field(default=None, repr=False, compare=False)
    """The clip in memory: then the paths of reference, terrain and base are names, not files."""

    @property
    def paths(self) -> dict[str, Path]:
        """The files that are named, by key."""
        values = {name: getattr(self, name) for name in keys(ClipEntry)}
        return {name: value for name, value in values.items() if isinstance(value, Path)}

    @property
    def contacts_files(self) -> tuple[Path, ...]:
        """The contacts files beside its clips, which no key names."""
        beside = [contacts_path(clip) for clip in (self.reference, self.base) if clip is not None]
        return tuple(path for path in dict.fromkeys(beside) if path.exists())

    def with_paths(self, change: Callable[[Path], Path]) -> "ClipEntry":
        """The entry with each of its paths changed."""
        return replace(self, **{name: change(path) for name, path in self.paths.items()})


@dataclass(frozen=True)
class FitOptions:
    """How the best fit is searched for."""

    starts: int = key(
        MAX_STARTS,
        "Independent starts of the search, at most, until enough of them agree.",
        "",
        1,
        1000,
    )
    search: SearchSettings = SearchSettings()


STEPS = ("max_steps",)  # settings of the search that stand in [fit] itself
SEARCH_KEYS = {name: entry for name, entry in keys(SearchSettings).items() if name not in STEPS}
FIT_KEYS = {
    "starts": keys(FitOptions)["starts"],
    **{name: keys(SearchSettings)[name] for name in STEPS},
    "search": Key(TABLE, "Settings of the search."),
}


@dataclass(frozen=True)
class Experiment(Displayable):
    """Parameters of a system, and the clips to which they are fitted.

    Raises:
        ValueError: for noise that cannot be estimated in this way.
    """

    path: Path
    """Of the file; relative paths in it start from there."""
    clips: tuple[ClipEntry, ...] = key(NEEDED, "The clips.", wanted="[[clips]], one for each clip")
    free: FreeTable = key(
        NEEDED,
        "What is fitted, if anything; {} leaves range, kind and scale to the rule's declaration.",
    )
    capture: FreeTable = key(
        {}, "Errors of the captures that are fitted beside the system, for each clip."
    )
    preset: str = key(DEFAULT_PRESET.name, "The system that is fitted.")
    faithful: bool = key(
        False, "Whether the preset is the original, where the preset differs from it."
    )
    body: Body = key(
        "clip",
        "Whose numbers and ranges are meant: those of the first clip's body, or of an adult of"
        " 1.8 m.",
    )
    name: str = key("", "Title of the experiment; left out, the file's name.")
    fps: float | None = key(
        None, "Rate to which clips are resampled; left out, none.", "Hz", 1, 1000
    )
    holdout: float = key(
        1 / 3,
        "Fraction of each clip, its end, that is not fitted but tests the fit; clips of less than"
        " 3 s are fitted whole.",
        "",
        0.0,
        0.9,
    )
    loss: Loss = key(
        "huber",
        "How residuals count; all but squares give a few wrong frames less influence. Left out,"
        " huber; squares where sigmas are estimated.",
    )
    independent_every: float = key(
        0.0, "Time between residuals that count as independent; at 0 as [noise] says.", "s", 0, 1e6
    )
    seed: int = key(0, "Of all random numbers.", "", 0, 2**32 - 1)
    rules: Mapping[str, str] = key({}, "Rules that differ from the preset's, by stage.")
    parameters: Mapping[str, object] = key({}, "Fixed values that differ from the preset's.")
    prior: Priors = key(Priors(), "The knowledge of free parameters before any clip.")
    start: Mapping[str, float] = key(
        {}, "Where the search begins; left out, at the system's values."
    )
    sigmas: Mapping[str, float] = key({}, "Standard deviation of each kind of residual.")
    noise: NoiseOptions = key(
        NoiseOptions(), "Which properties of the noise are estimated, and for which purpose."
    )
    fit: FitOptions = key(FitOptions(), "How the best fit is searched for.")
    sample: SamplerSettings = key(SamplerSettings(), "How `jaxik sample` samples the posterior.")
    without: tuple[Ablation, ...] = key(
        (), "Variants that `jaxik ablate` fits.", wanted="[[without]], one for each variant"
    )
    hierarchy: Hierarchy = key(
        Hierarchy(), "Which parameters several clips and subjects share; left out, all."
    )
    record_only: bool = key(
        False, "Whether free parameters that the game's record has no room for are left out."
    )
    written_in: str | None = key(
        None,
        "Where the file was written: there start paths that lead nowhere from the file itself, such"
        " as after moving a run alone.",
    )
    whole: "Experiment | None" = None
    """The unrestricted experiment, of one with `record_only`."""
    system: jaxik.FootIK | None = field(default=None, repr=False, compare=False)
    """With any rules, instead of those of preset and `rules`; for any body as it is."""

    def __post_init__(self) -> None:
        if self.noise.sigmas == "estimated" and self.loss not in ("squares", "student"):
            raise ValueError(
                f"{self.path}: [noise] sigmas cannot be estimated under the loss {self.loss!r}, "
                "which is not a distribution of noise; choose squares, or student for outliers"
            )
        if self.noise.correlation == "whitened" and self.independent_every:
            raise ValueError(
                f"{self.path}: independent_every and [noise] correlation = 'whitened' would "
                "account for the same correlation twice; leave one of them out"
            )
        if all(entry.held_out for entry in self.clips):
            raise ValueError(f"{self.path}: all clips are held out; wanted one that is not")
        for kind, least in LEAST_SIGMAS.items():
            if not self.sigmas.get(kind, least) >= least:
                raise ValueError(
                    f"{self.path} [sigmas]: {kind} is {self.sigmas[kind]:g}; wanted {least:g} or "
                    "more (m, rad), as no capture is known better"
                )

    def preset_system(self, rig: jaxik.Rig | None = None) -> jaxik.FootIK:
        """The preset with the experiment's rules, for a rig unless it is meant for the adult."""
        if self.system is not None:
            ik = with_floats(self.system, jnp.result_type(float))
            return with_rules(ik, self.rules, f"{self.path} [rules]")
        rig = rig if self.body == "clip" else None
        ik = Preset(self.preset, self.faithful).system(rig)
        return with_rules(ik, self.rules, f"{self.path} [rules]", rig)

    def starting_system(self, rig: jaxik.Rig | None = None) -> jaxik.FootIK:
        """The preset with the experiment's rules and fixed parameters; `rig` as above."""
        ik = self.preset_system(rig)
        return with_parameters(ik, self.parameters, f"{self.path} [parameters]")

    def leg_length(self, rig: jaxik.Rig) -> float | None:
        """Leg length, m, of the body that the numbers are for; None if they fit any body as is.

        `rig` is that of the first clip.
        """
        if not self.hierarchy.scale_with_body:
            return None
        return body.leg_length(rig) if self.body == "clip" else body.LEG

    def size(self, rig: jaxik.Rig, first: jaxik.Rig) -> float | None:
        """Leg length of a body over that of the body that the numbers are for; None as above.

        `first` is the rig of the first clip.
        """
        leg_length = self.leg_length(first)
        return None if leg_length is None else body.leg_length(rig) / leg_length

    def placed_clips(self) -> tuple[ClipEntry, ...]:
        """The clips, with the root as animated where the system places it itself."""
        if not self.parameters.get(OWN_ROOT, False):
            return self.clips
        return tuple(
            replace(entry, root="animation") if entry.root == "auto" else entry
            for entry in self.clips
        )

    def free_parameters(
        self, ik: jaxik.FootIK, rig: jaxik.Rig | None = None
    ) -> list[FreeParameter]:
        """The free parameters, as the rules declare them and the experiment overrides them.

        Their ranges are for the body of the rig, unless the experiment is meant for the adult.

        Raises:
            ValueError: a parameter is unknown, or cannot be what the experiment makes it.
        """
        with validation.error_context(f"{self.path} [free]"):
            rig = rig if self.body == "clip" else None
            free = [free_parameter(ik, name, rig, **given) for name, given in self.free.items()]
        with validation.error_context(f"{self.path} [capture]"):
            ik = self.with_capture(ik)
            return free + [
                free_parameter(ik, name, None, **given) for name, given in self._of_captures
            ]

    @property
    def _of_captures(self) -> list[tuple[str, Mapping[str, float | int | str]]]:
        """The free parameters of captures by dotted name, with overrides."""
        return list(file_tables.free_table(self.capture, len(self.clips)).items())

    @property
    def free_count(self) -> int:
        """How many parameters are free: of the system, and of captures."""
        return len(self.free) + len(self._of_captures)

    def with_capture(self, ik: jaxik.FootIK) -> jaxik.FootIK:
        """The system with the errors of the captures, if any are fitted."""
        return with_capture(ik, len(self.clips), list(self.capture)) if self.capture else ik

    def check_points(self, rig: jaxik.Rig | None) -> None:
        """Checks, before anything is compiled, that centres of priors and the start are in range.

        Raises:
            ValueError: one is not, or as `free_parameters`.
        """
        parameters = self.free_parameters(self.starting_system(rig), rig)
        centres = {name: prior.centre for name, prior in self.prior.named.items()}
        for table, what, values in (("prior", "centre", centres), ("start", "start", self.start)):
            with validation.error_context(f"{self.path} [{table}]"):
                for parameter in parameters:
                    value = file_tables.entry_for(parameter.name, values)
                    if value is not None:
                        check_inside(parameter, what, value)

    @property
    def has_points(self) -> bool:
        """Whether there are centres of priors or a start of the search."""
        return bool(self.start) or any(p.centre is not None for p in self.prior.named.values())

    def space(self, ik: jaxik.FootIK, rig: jaxik.Rig | None = None) -> Space[jaxik.FootIK]:
        """The space of the free parameters of its system, with their prior and the start.

        Raises:
            ValueError: as `free_parameters`; the parameters leave each other no room; the centre of
                a prior or the start is outside the range.
        """
        parameters = self.free_parameters(ik, rig)
        with validation.error_context(f"{self.path} [free]"):
            space = make_space(self.with_capture(ik), parameters)
        of_captures = [name for name, _ in self._of_captures]
        with validation.error_context(f"{self.path} [prior]"):
            space = space.with_prior(file_tables.with_narrow_priors(self.prior, of_captures))
        with validation.error_context(f"{self.path} [start]"):
            values = {name: file_tables.entry_for(name, self.start) for name in space.names}
            return space.with_start({name: v for name, v in values.items() if v is not None})

    def with_max_sample_steps(self, max_steps: int) -> "Experiment":
        """The experiment with another limit to the steps of the sampler."""
        sample = replace(self.sample, max_steps=max_steps)
        sample.walkers_for(self.free_count)
        return replace(self, sample=sample)
