"""Generates the shipped terrain and clips from seeds: `python data/make.py [-o FOLDER]`.

Terrains, `terrains/*.ply`. Flat animations over the floor y = 0, in `clips/`:

- `uneven_walk_base.npz`: a walk whose root runs 6 % faster than the feet step for a while, then
  slower, as game roots do. Feet therefore slide, and locks have something to correct. On the slope
  down the character slides.
- `stop_and_go_base.npz`: a walk that stands exactly still three times: on a slope, on a step and on
  rubble.
- `terraces_base.npz`: a walk of 6 s whose root runs 20 % faster than the feet step, then slower.
- `quadruped_base.npz` and `climber_base.npz`: bodies on four limbs; the climber is on the wall
  z = 0.

Two files for each experiment whose true parameters are known (`REFERENCES`), also in `clips/`:

- `NAME.npz`: the reference motion, which a preset with the true parameters makes of the flat
  animation, plus noise.
- `NAME_truth.toml`: the true parameters and the noise.

Numbers in clips are rounded to 2⁻²⁴, which halves the files. The same bytes come out every time.
"""

import argparse
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips import Clip, clip_frames, save_clip
from fitting.experiment import systems
from fitting.ground import meshes
from fitting.runtime.precision import in_float64
from fitting.synthetic import multi_limb, terrain_meshes, walker
from fitting.synthetic.walker import Slide, Slip, Stop
from jaxik.maths import parameter_tree
from jaxik.record.parameters import half_life_of_gain
from jaxik.world.terrain import Terrain

HERE = Path(__file__).resolve().parent
TERRAINS = {
    "slope": terrain_meshes.slope,
    "steps": terrain_meshes.steps,
    "rubble": terrain_meshes.rubble,
    "uneven_walk": terrain_meshes.uneven_walk,
    "stop_and_go": terrain_meshes.stop_and_go,
    "terraces": terrain_meshes.terraces,
    "meadow": terrain_meshes.meadow,
    "wall": terrain_meshes.wall,
}
SECONDS, FPS = 12.0, 30.0
SLIPS_AND_SLIDE = (Slip(0.6, 4.4, 0.06), Slip(5.6, 8.6, -0.06), Slide(8.8, 10.4))
STOPS = (Stop(1.6, 3.7), Stop(5.0, 7.2), Stop(8.6, 10.6))
SLIPS = (Slip(0.4, 2.6, 0.20), Slip(3.0, 5.8, -0.20))
POSITION_NOISE = 0.002  # m, per coordinate of a joint
ROTATION_NOISE = float(np.radians(0.5))  # rad, per axis of a joint
RESOLUTION = 2.0**-24  # m, and of quaternion components; 6e-8


def uneven_walk() -> Clip:
    """A walk with slips and a slide."""
    return walker.walk(SECONDS, FPS, 2, SLIPS_AND_SLIDE)


def stop_and_go() -> Clip:
    """A walk that stops."""
    return walker.walk(SECONDS, FPS, 4, STOPS)


def terraces() -> Clip:
    """A short walk with slips."""
    return walker.walk(6.0, FPS, 6, SLIPS)


def quadruped() -> Clip:
    """A quadruped that walks."""
    return multi_limb.locomotion(multi_limb.QUADRUPED, 5.0, FPS, 3)


def climber() -> Clip:
    """A climber on a wall."""
    return multi_limb.climb(6.0, FPS, 5)


FLAT_ANIMATIONS: Mapping[str, Callable[[], Clip]] = {
    "uneven_walk": uneven_walk,
    "stop_and_go": stop_and_go,
    "terraces": terraces,
    "quadruped": quadruped,
    "climber": climber,
}


@dataclasses.dataclass(frozen=True)
class SyntheticReference:
    """A reference motion made by a system with known parameters."""

    name: str
    base: str  # key of `FLAT_ANIMATIONS`, and name of the terrain
    preset: str
    truth: Mapping[str, float | bool]  # parameters that differ from the preset's
    seed: int  # of the noise
    faithful: bool = False  # whether the preset is the original


TICK_HZ = 30.0  # of the game whose record has these gains
RECORD_TRUTH = {
    "contact.planted_height": 0.125,
    "contact.raised_height": 0.20,
    "target.rise_half_life": 0.04,
    "target.fall_half_life": 0.07,
    "lean.forward_rate": -0.55,
    "lean.side_rate": 0.25,
    "lean.forward_rate_slide": 0.55,
    "lean.side_rate_slide": 0.85,
    "lean.half_life": half_life_of_gain(0.12, TICK_HZ),
    "lean.half_life_slide": half_life_of_gain(0.15, TICK_HZ),
    "lean.slide_on_half_life": half_life_of_gain(0.08, TICK_HZ),
    "lean.slide_off_half_life": half_life_of_gain(0.07, TICK_HZ),
    "lock.release_cone": 0.10,
    "lock.release_distance": 0.08,
    "lock.relock_threshold": 0.35,
    "lock.max_speed": 1.0,
    "lock.lock_half_life": 0.025,
    "lock.unlock_half_life": 0.06,
    "pelvis.limit": 0.22,
    "pelvis.half_life": half_life_of_gain(0.15, TICK_HZ),
    "leg.max_knee_angle": 2.85,
    "leg.soften": 0.98,
    "foot.max_pitch": 0.26,
    "foot.max_roll": 0.12,
}
OZZ_TRUTH = {
    "root.half_life": 0.0,  # as in the original
    "target.foot_height": 0.09,
    "leg.soften": 0.94,
    "leg.twist": 0.15,
    "leg.weight": 0.85,
    "foot.twist": -0.12,
    "foot.weight": 0.8,
}
UNREAL_TRUTH = {
    "root.enabled": False,  # as in the original
    "contact.idle_speed": 0.3,
    "target.adjust": 0.03,
    "pelvis.speed": 6.0,
    "effector.speed": 9.0,
    "leg.twist": 0.12,
    "leg.weight": 0.9,
}
MEC_TRUTH = {
    "root.enabled": True,  # the terrain differs from the floor on which the walk was made
    "root.half_life": 0.0,
    "probe.foot_length": 0.16,
    "probe.half_width": 0.035,
    "probe.stable_height": 0.095,
    "target.foot_height": 0.085,
    "lock.plant_weight": 0.8,
    "pelvis.max_length": 0.80,
    "pelvis.speed": 6.0,
    "effector.transition_time": 0.3,
    "leg.soften": 0.92,
    "leg.twist": 0.12,
    "foot.max_tilt": 0.2,
}
STRIDE_TRUTH = {
    "probe.steepness": 2.6,
    "probe.swing_as_animated": True,  # so that the clip's steps determine what the pelvis does
    "lock.enabled": True,  # the feet of the animation slip
    "lock.release_distance": 0.09,
    "lock.unlock_half_life": 0.05,
    "pelvis.highest_share": 0.5,
    "pelvis.extension": 0.93,
    "pelvis.rise_half_life": 0.08,
    "effector.extension": 0.95,
    "effector.max_lift": 0.4,
    "foot.max_pitch": 0.3,
}
REFERENCES = (
    SyntheticReference("uneven_walk", "uneven_walk", "record", RECORD_TRUTH, 11, True),
    SyntheticReference("stop_and_go_ozz", "stop_and_go", "ozz", OZZ_TRUTH, 21),
    SyntheticReference("stop_and_go_unreal", "stop_and_go", "unreal", UNREAL_TRUTH, 22),
    SyntheticReference("stop_and_go_mec", "stop_and_go", "mec", MEC_TRUTH, 23, True),
    SyntheticReference("terraces", "terraces", "stride", STRIDE_TRUTH, 24),
)


def flat_animation(name: str) -> Clip:
    """One of `FLAT_ANIMATIONS`, as it is stored."""
    return rounded(FLAT_ANIMATIONS[name]())


def reference_motion(reference: SyntheticReference, flat: Clip, terrain: Terrain) -> Clip:
    """What the pipeline with the true parameters makes of a flat animation, without noise."""
    preset = systems.Preset(reference.preset, reference.faithful)
    ik = parameter_tree.replace(preset.system(), reference.truth)
    result = jaxik.run(ik, flat.rig, terrain, clip_frames.frames_from_clip(flat))
    solved = clip_frames.clip_from_result(flat, result)
    return dataclasses.replace(solved, source=reference.name.replace("_", " "))


def with_noise(clip: Clip, seed: int) -> Clip:
    """The clip with independent normal noise on every joint in every frame.

    That of pelvis and legs does not depend on what else there is.
    """
    legs, joints = len(walker.LEGS), len(clip.joint_names)
    parts = [
        _noise(np.random.default_rng(seeds), clip.frame_count, count)
        for seeds, count in ((seed, legs), ((seed, 1), joints - legs))
    ]
    offsets, angles = (np.concatenate(part, axis=1) for part in zip(*parts, strict=True))
    positions = clip.positions_ws + offsets
    noise = Rotation.from_rotvec(angles.reshape(-1, 3))
    noisy = noise * Rotation.from_quat(clip.rotations_ws.reshape(-1, 4), scalar_first=True)
    rotations = noisy.as_quat(scalar_first=True).reshape(clip.rotations_ws.shape)
    return clip.with_motion(positions, rotations)


def _noise(
    rng: np.random.Generator, frames: int, joints: int
) -> tuple[Float64[np.ndarray, "frames joints 3"], Float64[np.ndarray, "frames joints 3"]]:
    """Offsets, m, and turns as rotation vectors, rad."""
    offsets = rng.normal(0.0, POSITION_NOISE, (frames, joints, 3))
    return offsets, rng.normal(0.0, ROTATION_NOISE, (frames * joints, 3)).reshape(offsets.shape)


def rounded(clip: Clip) -> Clip:
    """The clip with its motion rounded to multiples of `RESOLUTION`."""
    return dataclasses.replace(
        clip,
        positions_ws=np.round(clip.positions_ws / RESOLUTION) * RESOLUTION,
        rotations_ws=np.round(clip.rotations_ws / RESOLUTION) * RESOLUTION,
    )


def truth_text(reference: SyntheticReference) -> str:
    """The true parameters and the noise as TOML, with one table per rule."""
    base = f"{reference.base}_base.npz"
    lines = [f"# What made {reference.name}.npz of {base}; all else as in the preset."]
    lines += [f'preset = "{reference.preset}"']
    lines += ["faithful = true", ""] if reference.faithful else [""]
    for rule in dict.fromkeys(name.partition(".")[0] for name in reference.truth):
        lines.append(f"[{rule}]")
        for name, value in reference.truth.items():
            if name.startswith(f"{rule}."):
                lines.append(f"{name.partition('.')[2]} = {_toml(value)}")
        lines.append("")
    lines += ["[noise]  # standard deviations, independent in every frame"]
    lines += [f"position = {POSITION_NOISE!r}  # m, a coordinate of a joint"]
    lines += [f"rotation = {ROTATION_NOISE!r}  # rad, about an axis of a joint"]
    lines += [f"seed = {reference.seed}"]
    return "\n".join(lines) + "\n"


def _toml(value: float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


@in_float64
def make(folder: Path) -> None:
    """Writes all files to `folder`."""
    terrains, clips = folder / "terrains", folder / "clips"
    terrains.mkdir(parents=True, exist_ok=True)
    clips.mkdir(parents=True, exist_ok=True)
    for name, mesh in TERRAINS.items():
        meshes.save_mesh(terrains / f"{name}.ply", *mesh())
    flat_animations = {name: flat_animation(name) for name in FLAT_ANIMATIONS}
    for name, flat in flat_animations.items():
        save_clip(clips / f"{name}_base.npz", flat)
    for reference in REFERENCES:
        terrain = meshes.load_terrain(terrains / f"{reference.base}.ply")
        motion = reference_motion(reference, flat_animations[reference.base], terrain)
        save_clip(clips / f"{reference.name}.npz", rounded(with_noise(motion, reference.seed)))
        truth = clips / f"{reference.name}_truth.toml"
        truth.write_text(truth_text(reference), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Generates the terrain and clips of this folder.")
    parser.add_argument("-o", "--output", type=Path, default=HERE, help="folder to write to")
    make(parser.parse_args().output)
