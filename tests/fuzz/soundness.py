"""What everything that was loaded must be, whatever was in its file."""

from collections.abc import Mapping

import numpy as np

import jaxik
from fitting.clips.clip import Clip
from fitting.experiment.experiment import Experiment
from jaxik.maths import parameter_tree
from jaxik.world.heightfield import Heightfield
from jaxik.world.surfaces import Mesh
from jaxik.world.terrain import Terrain


def check_clip(clip: Clip) -> None:
    """Joints that are a tree, numbers that a body can have, and tracks as long as the clip."""
    joints = len(clip.joint_names)
    assert clip.frame_count >= 1 and clip.fps > 0 and clip.raw_frame_time > 0 and clip.scale > 0
    assert len(set(clip.joint_names)) == joints == len(clip.parents)
    assert all(-1 <= parent < i for i, parent in enumerate(clip.parents))
    assert clip.positions_ws.shape == (clip.frame_count, joints, 3)
    assert clip.rotations_ws.shape == (clip.frame_count, joints, 4)
    assert np.isfinite(clip.positions_ws).all()
    np.testing.assert_allclose(np.linalg.norm(clip.rotations_ws, axis=-1), 1, atol=0.01)
    assert np.isfinite(clip.offsets_ls).all()
    assert {track.shape[0] for track in clip.tracks.values()} <= {clip.frame_count}
    if clip.measured_rig is not None:
        named = [*np.ravel(clip.rig.joints), clip.rig.pelvis]
        assert min(named) >= 0 and max(named) < joints
        present = np.asarray(clip.rig.present)
        assert all(
            (np.asarray(bone)[present] > 0).all() for bone in (clip.rig.thigh, clip.rig.shin)
        )
        assert len(clip.stance_labels()) == len(clip.world_from_model().pos) == clip.frame_count
        assert all(0 < cut < clip.frame_count for cut in clip.cuts)


def check_tracks(clip: Clip, values: Mapping[str, np.ndarray]) -> None:
    """Weights from 0 to 1, and numbers for each frame."""
    for weight in (clip.grounded, clip.weight):
        assert weight is None or ((weight >= 0) & (weight <= 1)).all()
    for track in values.values():
        assert len(track) == clip.frame_count and not np.isnan(track).any()


def check_terrain(ground: Terrain) -> None:
    """Ground that is finite, and no larger in memory than a few times its triangles."""
    (surface,) = ground.surfaces
    if isinstance(surface, Heightfield):
        assert min(surface.heights.shape) >= 2 and not np.isinf(surface.heights).any()
        assert (np.asarray(surface.spacing) > 0).all() and np.isfinite(surface.spacing).all()
        assert np.isfinite(surface.origin_ws).all()
        return
    assert isinstance(surface, Mesh)
    vertices, triangles = np.asarray(surface.vertices_ws), np.asarray(surface.triangles)
    assert np.isfinite(vertices).all() and np.abs(vertices).max() <= 1e7
    assert 0 <= triangles.min() and triangles.max() < len(vertices)
    assert np.isfinite(surface.grid.corners).all() and np.isfinite(surface.grid.pitch)


def check_system(ik: jaxik.FootIK) -> None:
    """Parameters that are numbers."""
    for slot in parameter_tree.slots(ik):
        assert not np.isnan(np.asarray(parameter_tree.get(ik, slot.name), float)).any(), slot.name


def check_experiment(experiment: Experiment) -> None:
    """A system, and free parameters with room."""
    ik = experiment.starting_system()
    check_system(ik)
    for parameter in experiment.free_parameters(ik):
        assert parameter.low < parameter.high
