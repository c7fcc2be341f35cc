"""Makes all data of the project from its seeds: `python data/make.py`.

Terrains (`terrains/*.ply`), and for the experiment "uneven walk" three files in `clips/`:

- `uneven_walk_base.npz`, the flat base: a made walk on the floor y = 0. Its root runs ahead of the
  feet by 6 % for a while, then lags behind, as game roots do, so that feet slide and locks have
  work; on the slope down the character slides.
- `uneven_walk.npz`, the reference: what the `record` pipeline with known parameters makes of the
  base on the course, plus noise.
- `uneven_walk_truth.toml`: those parameters and the noise.

Numbers in clips are kept to 2⁻²⁴, which halves the files. The same bytes come out every time.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import jaxik
from fitting import course, frames, scenes, walker
from fitting.clips import Clip, save_clip
from jaxik import rule
from jaxik.terrain import Terrain

HERE = Path(__file__).resolve().parent
TERRAINS = {
    "slope": course.slope,
    "steps": course.steps,
    "rubble": course.stones,
    "uneven_walk": course.uneven,
}
SECONDS, FPS, WALK_SEED, NOISE_SEED = 12.0, 30.0, 2, 11
SLIPS = (walker.Slip(0.6, 4.4, 0.06), walker.Slip(5.6, 8.6, -0.06))
SLIDES = (walker.Slide(8.8, 10.4),)
POSITION_NOISE, ROTATION_NOISE = 0.002, float(np.radians(0.5))  # m a coordinate, rad an axis
GRAIN = 2.0**-24  # m, and of quaternions; 6e-8
TRUTH = {
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


def base() -> Clip:
    """The flat base of the uneven walk."""
    return kept(walker.walk(SECONDS, FPS, WALK_SEED, slips=SLIPS, slides=SLIDES))


def reference(base: Clip, terrain: Terrain) -> Clip:
    """The base as the pipeline with the true parameters has it, without noise."""
    ik = rule.replace(jaxik.presets.record(), TRUTH)
    result = jaxik.run(ik, base.rig, terrain, frames.frames_of(base))
    return dataclasses.replace(frames.solved_clip(base, result), source="uneven walk")


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


def truth_text() -> str:
    """The true parameters and the noise as TOML, a table a rule."""
    lines = ["# What made uneven_walk.npz of uneven_walk_base.npz; all else as in the preset."]
    lines += ['preset = "record"', ""]
    for room in dict.fromkeys(name.partition(".")[0] for name in TRUTH):
        own = [(name, value) for name, value in TRUTH.items() if name.startswith(f"{room}.")]
        lines += [
            f"[{room}]",
            *(f"{name.partition('.')[2]} = {value!r}" for name, value in own),
            "",
        ]
    lines += ["[noise]  # standard deviations, independent in every frame"]
    lines += [f"position = {POSITION_NOISE!r}  # m, a coordinate of a joint"]
    lines += [f"rotation = {ROTATION_NOISE!r}  # rad, about an axis of a joint"]
    lines += [f"seed = {NOISE_SEED}"]
    return "\n".join(lines) + "\n"


def make(folder: Path) -> None:
    """Writes everything below `folder`."""
    terrains, clips = folder / "terrains", folder / "clips"
    terrains.mkdir(parents=True, exist_ok=True)
    clips.mkdir(parents=True, exist_ok=True)
    for name, mesh in TERRAINS.items():
        scenes.save_mesh(terrains / f"{name}.ply", *mesh())
    flat = base()
    solved = reference(flat, scenes.load_terrain(terrains / "uneven_walk.ply"))
    save_clip(clips / "uneven_walk_base.npz", flat)
    save_clip(clips / "uneven_walk.npz", kept(noisy(solved, NOISE_SEED)))
    (clips / "uneven_walk_truth.toml").write_text(truth_text(), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Makes all data of the project.")
    parser.add_argument("-o", "--output", type=Path, default=HERE, help="folder to write to")
    jax.config.update("jax_enable_x64", True)
    make(parser.parse_args().output)
