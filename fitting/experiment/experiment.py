"""An experiment: which parameters of which system are fitted to which clips."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp

import jaxik
from fitting.clips import Clip
from fitting.clips.load import ClipOptions
from fitting.ground.meshes import TerrainOptions
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.solution import MAX_STARTS, SearchSettings
from fitting.inference.sample.blocks import SamplerSettings
from fitting.inference.sensitivity import FreeTable
from fitting.problem.capture_system import with_capture
from fitting.problem.problem import Loss
from fitting.problem.scene import LEAST_SIGMAS
from fitting.problem.space import (
    FreeParameter,
    Priors,
    Space,
    check_inside,
    free_parameter,
    make_space,
)
from fitting.runtime import validation
from fitting.runtime.display import Shown
from fitting.runtime.precision import with_floats
from jaxik.world import body
from jaxik.world.terrain import Terrain

from . import file_tables
from .file_tables import Ablation, Hierarchy
from .systems import DEFAULT_PRESET, OWN_ROOT, Preset, with_parameters, with_rules

DEFAULT_SIGMAS = {  # what a good fit of captured motion leaves
    "ankle": 0.02,  # m
    "knee": 0.03,  # m
    "pelvis": 0.02,  # m
    "foot": 0.10,  # rad
    "body": float("inf"),  # rad
    "contact": float("inf"),
    "smooth": float("inf"),  # m/s²
    "correlation": 0.0,
}


class LoadedFiles(NamedTuple):
    """The files of a clip, in memory."""

    reference: Clip
    terrain: Terrain
    base: Clip | None = None


@dataclass(frozen=True)
class ClipEntry:
    """One clip of an experiment."""

    reference: Path
    """The captured motion."""
    terrain: Path
    base: Path | None = None
    """The flat animation; None makes one from the reference."""
    truth: Path | None = None
    """Parameters that made a synthetic reference, for the report."""
    start: float = 0.0
    """Seconds."""
    end: float | None = None
    """Seconds."""
    file_up: str = "y"
    """Up axis of the terrain's file."""
    label: str = "captured"
    """What plots call the reference."""
    mask_pops: bool = True
    """Ignores frames in which a captured marker jumps."""
    held_out: bool = False
    """Not fitted, but compared with; then no other clip has a part that is held out."""
    root: str = "auto"
    """Where the base's root is put: one of `ground_path.ROOTS`."""
    tracks: Path | None = None
    """What changes along the base; see `track_files`."""
    subject: str | None = None
    """Whom it shows."""
    joints: Mapping[str, str] | Path | None = None
    """Which joint of reference and base is which; here and below, an `.npz` needs none of it."""
    scale: float | None = None
    """Metres per unit of reference and base."""
    up: str | None = None
    """Up axis of reference and base."""
    asf: Path | None = None
    """Skeleton of an `.amc`."""
    animation: str | None = None
    """Which animation of a glTF file that has several."""
    travel: str | None = None
    """Whether the roots of reference and base travel as standing feet show."""
    sole: float | None = None
    """m, of the balls of their feet over the soles."""
    terrain_scale: float | None = None
    """Metres per unit of the terrain's file."""
    terrain_offset: tuple[float, float, float] | None = None
    """m, by which the terrain is moved."""
    terrain_cell: float | None = None
    """m, between heights of a terrain that does not say it."""
    loaded: LoadedFiles | None = field(default=None, repr=False, compare=False)
    """What is in memory: then the paths of reference, terrain and base are names, and no files."""

    @staticmethod
    def reading(clip: ClipOptions, terrain: TerrainOptions) -> dict[str, Any]:
        """The fields that say how reference, base and terrain are read; paths become absolute."""
        joints = clip.joints
        return {
            **vars(clip),
            "joints": Path(joints).resolve() if isinstance(joints, str | Path) else joints,
            "asf": None if clip.asf is None else clip.asf.resolve(),
            "file_up": terrain.file_up,
            "terrain_scale": terrain.scale,
            "terrain_offset": terrain.offset if any(terrain.offset) else None,
            "terrain_cell": terrain.cell,
        }

    @property
    def clip_options(self) -> ClipOptions:
        """How reference and base are read."""
        return ClipOptions(
            **{field.name: getattr(self, field.name) for field in fields(ClipOptions)}
        )

    @property
    def terrain_options(self) -> TerrainOptions:
        """How the terrain is read."""
        offset = self.terrain_offset or (0.0, 0.0, 0.0)
        return TerrainOptions(self.file_up, self.terrain_scale, offset, self.terrain_cell)

    def with_paths(self, change: Callable[[Path], Path]) -> "ClipEntry":
        """The entry with each of its paths changed."""
        paths = {key: value for key, value in vars(self).items() if isinstance(value, Path)}
        return replace(self, **{key: change(path) for key, path in paths.items()})


@dataclass(frozen=True)
class FitOptions:
    """How the best fit is searched for."""

    starts: int = MAX_STARTS
    """At most."""
    search: SearchSettings = SearchSettings()


@dataclass(frozen=True)
class Experiment(Shown):
    """What is fitted to what.

    Raises:
        ValueError: for noise that cannot be estimated in this way.
    """

    path: Path
    """Of the file; relative paths in it start from there."""
    clips: tuple[ClipEntry, ...]
    free: FreeTable
    """By dotted name, with overrides of the declaration."""
    capture: FreeTable = field(default_factory=dict)
    """What of the captures is fitted, too; see `captures`."""
    preset: str = DEFAULT_PRESET.name
    faithful: bool = False
    """Whether the preset is the original, as faithful as it is known."""
    body: str = "clip"
    """Whose defaults are meant: those of the first clip's rig, or of the adult."""
    name: str = ""
    fps: float | None = None
    """Clips are resampled to this rate."""
    holdout: float = 1 / 3
    """Fraction of each clip, its end, that is not fitted but compared with."""
    loss: Loss = "huber"
    independent_every: float = 0.0
    """s, spacing at which residuals are independent; 0: as they themselves say."""
    seed: int = 0
    rules: Mapping[str, str] = field(default_factory=dict)
    """By stage, where not the preset's."""
    parameters: Mapping[str, object] = field(default_factory=dict)
    """Fixed values by dotted name."""
    prior: Priors = Priors()
    """Of the free parameters."""
    start: Mapping[str, float] = field(default_factory=dict)
    """Where the search begins, by dotted name; left out: at the system's values."""
    sigmas: Mapping[str, float] = field(default_factory=dict)
    """Where not the default."""
    noise: NoiseOptions = NoiseOptions()
    """Which properties of the noise are estimated."""
    fit: FitOptions = FitOptions()
    sample: SamplerSettings = SamplerSettings()
    without: tuple[Ablation, ...] = ()
    """What `jaxik ablate` leaves out in turn."""
    hierarchy: Hierarchy = Hierarchy()
    """What the clips have in common."""
    record_only: bool = False
    """Whether only what the game's record holds is fitted; see `record_files.restrict`."""
    whole: "Experiment | None" = None
    """What such an experiment was made of."""
    system: jaxik.FootIK | None = field(default=None, repr=False, compare=False)
    """With any rules, instead of those of preset and `rules`; for any body as it is."""

    def __post_init__(self) -> None:
        if self.noise.sigmas == "estimated" and self.loss not in ("squares", "student"):
            raise ValueError(
                f"{self.path}: [noise] sigmas cannot be estimated under the loss {self.loss!r}, "
                "which is not a distribution of noise; take squares, or student for outliers"
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

        Args:
            rig: of the first clip.
        """
        if not self.hierarchy.scale_with_body:
            return None
        return body.leg_length(rig) if self.body == "clip" else body.LEG

    def size(self, rig: jaxik.Rig, first: jaxik.Rig) -> float | None:
        """Leg length of a body over that of the body that the numbers are for; None as above.

        Args:
            rig: of the body.
            first: of the first clip.
        """
        leg_length = self.leg_length(first)
        return None if leg_length is None else body.leg_length(rig) / leg_length

    def placed_clips(self) -> tuple[ClipEntry, ...]:
        """The clips, with the root as animated where the system is told to place it itself."""
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

        Args:
            ik: the experiment's system.
            rig: whose body their ranges are for, unless the experiment is meant for the adult.

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
        """The system with what is not known of the captures, if something of it is fitted."""
        return with_capture(ik, len(self.clips), list(self.capture)) if self.capture else ik

    def check_points(self, rig: jaxik.Rig | None) -> None:
        """Checks, before anything is compiled, that centres of priors and the start are in range.

        Args:
            rig: of the first clip.

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
        """The space of the free parameters, with their prior and the start.

        Args:
            ik: the experiment's system.
            rig: as for `free_parameters`.

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
