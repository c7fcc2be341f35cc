"""Damaged clip archives load as sound clips or are refused in one sentence that names the file."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.clips.clip import Clip
from fitting.datasets.clips.edit import mask_pops
from support.sample_clips import stair_walk

VALUES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-320, 1e20, 1e308, 2**62)
DTYPES = ("f4", "i8", "u1", "?", "U4", "S3", "c16", "M8[s]")
MUTANTS = 60  # of each kind


@pytest.fixture(scope="module")
def content(tmp_path_factory) -> dict[str, np.ndarray]:
    """The arrays of a whole clip."""
    path = tmp_path_factory.mktemp("clips") / "whole.npz"
    save_clip(path, mask_pops(stair_walk()).select(slice(0, 20)))
    return dict(np.load(path))


def change_value(random: np.random.Generator, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiu" or not array.size:
        return array.ravel()[:0]
    changed = array.copy()
    with np.errstate(all="ignore"):
        value = np.asarray(random.choice(VALUES)).astype(array.dtype)
    changed.flat[random.integers(array.size)] = value
    return changed


def change_dtype(random: np.random.Generator, array: np.ndarray) -> np.ndarray:
    with np.errstate(all="ignore"):
        try:
            return array.astype(random.choice(DTYPES))
        except (TypeError, ValueError):
            return np.array("text")


def change_shape(random: np.random.Generator, array: np.ndarray) -> np.ndarray:
    changes = [array[None], array.ravel()[:0], array.ravel(), np.concatenate([array.ravel()] * 2)]
    if array.ndim:
        changes += [array[:1], array[..., :1], array[::-1], np.concatenate([array, array])]
    return changes[random.integers(len(changes))]


def swap_rows(random: np.random.Generator, array: np.ndarray) -> np.ndarray:
    return random.permutation(array) if array.ndim else array[None]


def scale(random: np.random.Generator, array: np.ndarray) -> np.ndarray:
    return (
        array * 10.0 ** random.integers(-300, 300) if array.dtype.kind == "f" else array[..., None]
    )


def check(path: Path) -> bool:
    """Whether the file was accepted; then it must hold a sound clip."""
    try:
        clip = load_clip(path)
    except ValueError as error:
        assert str(path) in str(error) and "\n" not in str(error)
        return False
    check_sound(clip)
    return True


def check_sound(clip: Clip) -> None:
    joints = len(clip.joint_names)
    assert clip.frame_count >= 1 and clip.fps > 0 and clip.raw_frame_time > 0 and clip.scale > 0
    assert len(set(clip.joint_names)) == joints == len(clip.parents)
    assert all(-1 <= parent < i for i, parent in enumerate(clip.parents))
    assert clip.positions_ws.shape == (clip.frame_count, joints, 3)
    assert clip.rotations_ws.shape == (clip.frame_count, joints, 4)
    assert np.isfinite(clip.positions_ws).all() and np.abs(clip.positions_ws).max() <= 1e6
    np.testing.assert_allclose(np.linalg.norm(clip.rotations_ws, axis=-1), 1, atol=0.01)
    assert np.isfinite(clip.offsets_ls).all()
    assert {track.shape[0] for track in clip.tracks.values()} <= {clip.frame_count}
    if clip.measured_rig is not None:
        named = [*np.ravel(clip.rig.joints), clip.rig.pelvis]
        assert min(named) >= 0 and max(named) < joints
        assert (np.asarray(clip.rig.thigh) > 0).all() and (np.asarray(clip.rig.shin) > 0).all()
        assert len(clip.stance_labels()) == len(clip.world_from_model().pos) == clip.frame_count
        assert all(0 < cut < clip.frame_count for cut in clip.cuts)


MUTATORS = (change_value, change_dtype, change_shape, swap_rows, scale)


@pytest.mark.parametrize("mutate", MUTATORS, ids=[f.__name__ for f in MUTATORS])
def test_an_archive_with_a_changed_array(mutate, content, tmp_path):
    random, path = np.random.default_rng(0), tmp_path / "clip.npz"
    for _ in range(MUTANTS):
        name = str(random.choice(sorted(content)))
        np.savez(path, **(content | {name: mutate(random, content[name])}))
        check(path)


def test_an_archive_without_an_array_or_with_names_that_repeat(content, tmp_path):
    path = tmp_path / "clip.npz"
    for name in content:
        np.savez(path, **{other: array for other, array in content.items() if other != name})
        check(path)
    for name in ("joint_names", "rig_names"):
        np.savez(path, **(content | {name: np.repeat(content[name][:1], len(content[name]))}))
        assert not check(path)


def test_an_archive_with_changed_bytes(content, tmp_path):
    random, path = np.random.default_rng(1), tmp_path / "clip.npz"
    np.savez_compressed(path, **content)
    whole = path.read_bytes()
    for _ in range(2 * MUTANTS):
        damaged = bytearray(whole)
        for place in random.integers(len(damaged), size=random.integers(1, 9)):
            damaged[place] = random.integers(256)
        path.write_bytes(
            damaged[: random.integers(1, len(damaged))] if random.random() < 0.3 else damaged
        )
        check(path)


def test_an_archive_that_claims_more_than_memory_is_refused_before_it_is_read(content, tmp_path):
    path = tmp_path / "clip.npz"
    np.savez_compressed(path, **content)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("bomb.npy", "w", force_zip64=True) as file:
            for _ in range(2200):
                file.write(bytes(2**20))
    assert path.stat().st_size < 2**23
    with pytest.raises(
        ValueError, match="its arrays take 2[0-9]{9} bytes; wanted 2147483648 at most"
    ):
        load_clip(path)
