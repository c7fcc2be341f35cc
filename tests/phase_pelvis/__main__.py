"""Whether a pelvis that shifts and tilts pays: `PYTHONPATH=tests python -m phase_pelvis BLOCKS`.

BLOCKS is the folder of the blocks benchmark. Its bases keep the captured pelvis' way and turns, so
they cannot tell. Here the pelvis of its flat animation is put where it goes on average at this
phase of the gait and this place of the feet, and is pitched as on average at this phase: it knows
nothing of heights. Printed are the rms errors of `stride` on both halves of the walk, by
`pelvis.shift` and by `lean.pelvis_rate`, all other parameters as they come.
"""

import argparse
import tempfile
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

import jaxik
from fitting.clips.clip_frames import positions_by_role
from fitting.experiment import systems
from fitting.studies.animations import Animation, AnimationFiles, load_animation
from jaxik.maths import parameter_tree

UP = np.array([0.0, 1.0, 0.0])
LONGEST = 0.9999  # of its length, of a leg
# As in `data/experiments/blocks_walk.toml`: the pelvis needs no smoothing on these blocks.
EXACT = {f"pelvis.{name}": 0.0 for name in ("landing_time", "rise_half_life", "fall_half_life")}
EXACT |= {"pelvis.spring": False}
SHIFTS, RATES = (0.0, 0.1, 0.15, 0.2, 0.3), (0.0, -0.15, -0.25, -0.4)


def row_lengths(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(errors**2)))


def forward_of(hips: np.ndarray) -> np.ndarray:
    """Where the pelvis faces, level (frames 3), of its hips (frames legs 3), left leg first."""
    left = (hips[:, 0] - hips[:, 1]) * [1.0, 0.0, 1.0]
    return np.cross(left / row_lengths(left), UP)


def pitch_of(rot: Rotation, forward: np.ndarray) -> np.ndarray:
    """How far the pelvis leans forward, rad."""
    up = rot.apply(UP)
    return np.arctan2(np.sum(up * forward, -1), up[:, 1])


def phases_of(stance: np.ndarray) -> np.ndarray:
    """Phase of each leg (frames legs): 0 to π in a stance, π to 2 π in the swing after it."""
    phases = np.zeros(stance.shape)
    for leg, standing in enumerate(stance.T):
        changes = [0, *(np.flatnonzero(np.diff(standing)) + 1), len(standing)]
        for start, end in zip(changes, changes[1:], strict=False):
            part = np.linspace(0.0, np.pi, end - start, endpoint=False)
            phases[start:end, leg] = part + (0.0 if standing[start] else np.pi)
    return phases


def fitted(values: np.ndarray, *columns: np.ndarray) -> np.ndarray:
    """The values as linear in the columns, by least squares."""
    basis = np.column_stack(columns)
    return basis @ np.linalg.lstsq(basis, values, rcond=None)[0]


def with_pelvis_by_phase(clip: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The benchmark's clip whose flat animation has a pelvis that knows of no heights."""
    rot = Rotation.from_quat(clip["pelvis_rot"], scalar_first=True)
    forward = forward_of(clip["hip"])
    phases = phases_of(clip["stance"].astype(bool))
    waves = [f(n * phases) for n in (1, 2) for f in (np.sin, np.cos)]
    phase = np.column_stack([np.ones(len(phases)), *waves])
    feet = clip["ball"][:, 0] - clip["ball"][:, 1]
    ahead = np.sum(feet * forward, -1)
    aside = np.sum(feet * np.cross(UP, forward), -1)
    turned = [ahead * f(phases[:, 0]) for f in (np.sin, np.cos)]
    place = np.sum((clip["pelvis"] - clip["ball"].mean(1)) * forward, -1)
    usual = fitted(place, phase, ahead, aside, *turned, aside * np.cos(phases[:, 0]))
    move = forward * (usual - place)[:, None]
    pitch = pitch_of(rot, forward)
    turn = Rotation.from_rotvec(np.cross(UP, forward) * (fitted(pitch, phase) - pitch)[:, None])

    middle = clip["base_hip"].mean(1)

    def moved(points: np.ndarray) -> np.ndarray:
        return turn.apply(points - middle) + middle + move

    hips = np.stack([moved(hip) for hip in clip["base_hip"].swapaxes(0, 1)], 1)
    return clip | {
        "pelvis_rot": (turn * rot).as_quat(scalar_first=True).astype(clip["pelvis_rot"].dtype),
        "base_pelvis": moved(clip["base_pelvis"]),
        "base_hip": hips,
        "base_knee": knees(hips, clip),
    }


def knees(hips: np.ndarray, clip: dict[str, np.ndarray]) -> np.ndarray:
    """Knees of legs from these hips to the animated ankles, bent to where they were."""
    thigh, shin = clip["leg_lengths"].T
    to_ankle = clip["base_ankle"] - hips
    reach = np.minimum(row_lengths(to_ankle)[..., 0], LONGEST * (thigh + shin))
    along = to_ankle / row_lengths(to_ankle)
    pole = clip["base_knee"] - clip["base_hip"]
    pole = pole - along * np.sum(pole * along, -1, keepdims=True)
    part = (thigh**2 - shin**2 + reach**2) / (2.0 * reach)
    bend = np.sqrt(np.maximum(thigh**2 - part**2, 0.0))
    return hips + along * part[..., None] + pole / row_lengths(pole) * bend[..., None]


def errors_of(
    animation: Animation, ik: jaxik.FootIK, captured: dict[str, np.ndarray], base: np.ndarray
) -> list[list[float]]:
    """Of both halves, rms of hips ahead and of knees, cm, and of the pelvis' pitch, degrees.

    `base` are the rotations of the flat animation's pelvis.
    """
    result, solved = animation.solve(ik)
    joints = positions_by_role(solved)
    forward = forward_of(captured["hip"])
    off = np.mean(joints["hip"] - captured["hip"], 1)
    world = Rotation.from_quat(animation.frames.world_from_model.rot, scalar_first=True)
    body = world * Rotation.from_quat(result.body.rot, scalar_first=True) * world.inv()
    rots = body * Rotation.from_quat(base, scalar_first=True)
    true_rots = Rotation.from_quat(captured["pelvis_rot"], scalar_first=True)
    pitch = np.degrees(pitch_of(rots, forward) - pitch_of(true_rots, forward))
    ahead, knees_off = np.sum(off * forward, -1), row_lengths(joints["knee"] - captured["knee"])
    errors, half = (100.0 * ahead, 100.0 * knees_off, pitch), len(off) // 2
    return [[rms(x[part]) for x in errors] for part in (slice(half), slice(half, None))]


def main() -> None:
    """Prints the errors by each parameter."""
    parser = argparse.ArgumentParser(description="Whether a pelvis that shifts and tilts pays.")
    parser.add_argument("blocks", type=Path, help="folder of the blocks benchmark")
    folder = parser.parse_args().blocks
    jax.config.update("jax_enable_x64", True)
    captured = dict(np.load(folder / "03_03_walk.npz"))
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "phase.npz"
        clip = with_pelvis_by_phase(captured)
        np.savez(path, allow_pickle=False, **clip)
        animation = load_animation(AnimationFiles(clip=path, terrain=folder / "terrain.ply"))
    stride = systems.preset_system("stride", animation.clip.rig)
    for name, values in (("pelvis.shift", SHIFTS), ("lean.pelvis_rate", RATES)):
        other = "lean.pelvis_rate" if name == "pelvis.shift" else "pelvis.shift"
        print(f"{name}: hips ahead cm, knees cm, pitch of the pelvis °; first half | second half")
        for value in values:
            ik = parameter_tree.replace(stride, EXACT | {other: 0.0, name: value})
            halves = errors_of(animation, ik, captured, clip["pelvis_rot"])
            numbers = ["  ".join(f"{error:.2f}" for error in half) for half in halves]
            print(f"{value:6.2f}  ", "  |  ".join(numbers))


if __name__ == "__main__":
    main()
