"""Makes all data of the project from its seeds: `python data/make.py`.

Terrains (`terrains/*.ply`), and in `clips/` flat bases, made on the floor y = 0:

- `uneven_walk_base.npz`: a walk whose root runs ahead of the feet by 6 % for a while, then lags
  behind, as game roots do, so that feet slide and locks have work; on the slope down the character
  slides.
- `stop_and_go_base.npz`: a walk that stands exactly still three times, on a slope, on a step and on
  rubble.
- `quadruped_base.npz` and `climber_base.npz`: bodies on four limbs; the climber is on the wall
  z = 0.

and for each of the experiments with a known truth (`MADE`) two more:

- `NAME.npz`, the reference: what a preset with known parameters makes of the base, plus noise.
- `NAME_truth.toml`: those parameters and the noise.

Numbers in clips are kept to 2⁻²⁴, which halves the files. The same bytes come out every time.
"""

import argparse
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import jaxik
from fitting.datasets import clip_frames
from fitting.datasets.clips import Clip, save_clip
from fitting.datasets.synthetic import multi_limb, terrain_meshes, walker
from fitting.datasets.synthetic.speed_profile import Slide, Slip, Stop
from fitting.datasets.terrain import mesh_files
from fitting.experiments import systems
from jaxik.maths import parameter_tree
from jaxik.world.terrain import Terrain

HERE = Path(__file__).resolve().parent
TERRAINS = {
    "slope": terrain_meshes.slope,
    "steps": terrain_meshes.steps,
    "rubble": terrain_meshes.rubble,
    "uneven_walk": terrain_meshes.uneven_walk,
    "stop_and_go": terrain_meshes.stop_and_go,
    "meadow": terrain_meshes.meadow,
    "wall": terrain_meshes.wall,
}
SECONDS, FPS, NOISE_SEED = 12.0, 30.0, 11
SLIPS = (Slip(0.6, 4.4, 0.06), Slip(5.6, 8.6, -0.06))
SLIDES = (Slide(8.8, 10.4),)
STOPS = (Stop(1.6, 3.7), Stop(5.0, 7.2), Stop(8.6, 10.6))
POSITION_NOISE, ROTATION_NOISE = 0.002, float(np.radians(0.5))  # m a coordinate, rad an axis
GRAIN = 2.0**-24  # m, and of quaternions; 6e-8


def uneven_walk() -> Clip:
    """The flat base of the uneven walk."""
    return walker.walk(SECONDS, FPS, 2, (*SLIPS, *SLIDES))


def stop_and_go() -> Clip:
    """The flat base of the walk that stops."""
    return walker.walk(SECONDS, FPS, 4, STOPS)


def quadruped() -> Clip:
    """A quadruped's walk."""
    return multi_limb.locomotion(multi_limb.QUADRUPED, 5.0, FPS, 3)


def climber() -> Clip:
    """A climb."""
    return multi_limb.climb(6.0, FPS, 5)


BASES: Mapping[str, Callable[[], Clip]] = {
    "uneven_walk": uneven_walk,
    "stop_and_go": stop_and_go,
    "quadruped": quadruped,
    "climber": climber,
}


@dataclasses.dataclass(frozen=True)
class Made:
    """A reference made by a system with known parameters."""

    name: str
    base: str  # of `BASES`, and of the terrain
    preset: str
    truth: Mapping[str, float | bool]  # where the system differs from the preset
    seed: int  # of the noise


RECORD = {
    "contact.planted_height": 0.125,
    "contact.raised_height": 0.20,
    "target.rise_half_life": 0.04,
    "target.fall_half_life": 0.07,
    "lean.forward_rate": -0.55,
    "lean.side_rate": 0.25,
    "lean.forward_rate_slide": 0.55,
    "lean.side_rate_slide": 0.85,
    "lean.gain": 0.12,
    "lean.gain_slide": 0.15,
    "lean.slide_on_gain": 0.08,
    "lean.slide_off_gain": 0.07,
    "lock.release_cone": 0.10,
    "lock.release_distance": 0.08,
    "lock.relock_threshold": 0.35,
    "lock.max_speed": 1.0,
    "lock.lock_half_life": 0.025,
    "lock.unlock_half_life": 0.06,
    "pelvis.limit": 0.22,
    "pelvis.on_gain": 0.15,
    "leg.max_knee_angle": 2.85,
    "foot.max_pitch": 0.26,
    "foot.max_roll": 0.12,
}
OZZ = {
    "target.foot_height": 0.09,
    "leg.soften": 0.94,
    "leg.twist": 0.15,
    "leg.weight": 0.85,
    "foot.twist": -0.12,
    "foot.weight": 0.8,
}
UNREAL = {
    "contact.idle_speed": 0.3,
    "target.adjust": 0.03,
    "pelvis.speed": 6.0,
    "effector.speed": 9.0,
    "effector.mesh_scale": 1.15,
    "leg.twist": 0.12,
    "leg.weight": 0.9,
}
MEC = {
    "root.enabled": True,  # the ground under this walk is not the floor on which it was made
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
MADE = (
    Made("uneven_walk", "uneven_walk", "record", RECORD, NOISE_SEED),
    Made("stop_and_go_ozz", "stop_and_go", "ozz", OZZ, 21),
    Made("stop_and_go_unreal", "stop_and_go", "unreal", UNREAL, 22),
    Made("stop_and_go_mec", "stop_and_go", "mec", MEC, 23),
)


def base(name: str) -> Clip:
    """A flat base by its name, as it is kept."""
    return kept(BASES[name]())


def reference(made: Made, flat: Clip, terrain: Terrain) -> Clip:
    """The flat base as the pipeline with the true parameters has it, without noise."""
    ik = parameter_tree.replace(systems.preset_system(made.preset), made.truth)
    result = jaxik.run(ik, flat.rig, terrain, clip_frames.frames_from_clip(flat))
    return dataclasses.replace(
        clip_frames.clip_from_result(flat, result), source=made.name.replace("_", " ")
    )


def noisy(clip: Clip, seed: int) -> Clip:
    """The clip as a camera might see it: independent normal noise on every joint."""
    rng = np.random.default_rng(seed)
    positions = clip.positions_ws + rng.normal(0.0, POSITION_NOISE, clip.positions_ws.shape)
    shaken = Rotation.from_rotvec(rng.normal(0.0, ROTATION_NOISE, (positions[..., 0].size, 3)))
    turned = shaken * Rotation.from_quat(clip.rotations_ws.reshape(-1, 4), scalar_first=True)
    rotations = turned.as_quat(scalar_first=True).reshape(clip.rotations_ws.shape)
    return clip.with_motion(positions, rotations)


def kept(clip: Clip) -> Clip:
    """The clip with its motion rounded to multiples of `GRAIN`."""
    return dataclasses.replace(
        clip,
        positions_ws=np.round(clip.positions_ws / GRAIN) * GRAIN,
        rotations_ws=np.round(clip.rotations_ws / GRAIN) * GRAIN,
    )


def truth_text(made: Made) -> str:
    """The true parameters and the noise as TOML, a table a rule."""
    lines = [f"# What made {made.name}.npz of {made.base}_base.npz; all else as in the preset."]
    lines += [f'preset = "{made.preset}"', ""]
    for room in dict.fromkeys(name.partition(".")[0] for name in made.truth):
        own = [(name, value) for name, value in made.truth.items() if name.startswith(f"{room}.")]
        lines += [
            f"[{room}]",
            *(f"{name.partition('.')[2]} = {_toml(value)}" for name, value in own),
            "",
        ]
    lines += ["[noise]  # standard deviations, independent in every frame"]
    lines += [f"position = {POSITION_NOISE!r}  # m, a coordinate of a joint"]
    lines += [f"rotation = {ROTATION_NOISE!r}  # rad, about an axis of a joint"]
    lines += [f"seed = {made.seed}"]
    return "\n".join(lines) + "\n"


def _toml(value: float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def make(folder: Path) -> None:
    """Writes everything below `folder`."""
    terrains, clips = folder / "terrains", folder / "clips"
    terrains.mkdir(parents=True, exist_ok=True)
    clips.mkdir(parents=True, exist_ok=True)
    for name, mesh in TERRAINS.items():
        mesh_files.save_mesh(terrains / f"{name}.ply", *mesh())
    bases = {name: base(name) for name in BASES}
    for name, flat in bases.items():
        save_clip(clips / f"{name}_base.npz", flat)
    for made in MADE:
        terrain = mesh_files.load_terrain(terrains / f"{made.base}.ply")
        solved = reference(made, bases[made.base], terrain)
        save_clip(clips / f"{made.name}.npz", kept(noisy(solved, made.seed)))
        truth = clips / f"{made.name}_truth.toml"
        truth.write_text(truth_text(made), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Makes all data of the project.")
    parser.add_argument("-o", "--output", type=Path, default=HERE, help="folder to write to")
    jax.config.update("jax_enable_x64", True)
    make(parser.parse_args().output)
