"""Clip archives in particular: each kind of damage to arrays, missing ones, and bombs."""

import io
import zipfile

import numpy as np
import pytest

from fitting.datasets import archives
from fitting.datasets.clips import load_clip
from fuzz.damage import ARRAY_DAMAGES, archive_of
from fuzz.formats import FORMATS, clip_bytes
from fuzz.trial import OUTCOMES, try_to_load

FORM = FORMATS["clip, NPZ"]
COUNT = 60  # of each kind of damage


@pytest.fixture(scope="module")
def content() -> dict[str, np.ndarray]:
    """The arrays of a whole clip."""
    with np.load(io.BytesIO(clip_bytes(".npz"))) as archive:
        return dict(archive)


@pytest.fixture
def outcome(tmp_path):
    """A function from arrays to what becomes of their archive."""
    path = tmp_path / FORM.file

    def load(arrays: dict[str, np.ndarray]) -> str:
        path.write_bytes(archive_of(arrays))
        return try_to_load(FORM.load, path, FORM.names)

    return load


@pytest.mark.parametrize("damage", ARRAY_DAMAGES, ids=[f.__name__ for f in ARRAY_DAMAGES])
def test_an_archive_with_a_changed_array(damage, content, outcome):
    random = np.random.default_rng(0)
    for _ in range(COUNT):
        name = str(random.choice(sorted(content)))
        assert outcome(content | {name: damage(random, content[name])}) in OUTCOMES


def test_an_archive_without_an_array_or_with_names_that_repeat(content, outcome):
    for name in content:
        arrays = {other: array for other, array in content.items() if other != name}
        assert outcome(arrays) in OUTCOMES
    for name in ("joint_names", "rig_names"):
        repeated = np.repeat(content[name][:1], len(content[name]))
        assert outcome(content | {name: repeated}) == "refused"


def test_a_small_archive_of_large_arrays_is_refused_before_it_is_read(
    content, tmp_path, monkeypatch
):
    path = tmp_path / "clip.npz"
    np.savez_compressed(path, **content)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.npy", bytes(2**24))
    monkeypatch.setattr(archives, "MAX_BYTES", 2**24)
    assert path.stat().st_size < 2**17
    with pytest.raises(ValueError, match="its arrays take 16[0-9]{6} bytes; wanted 16777216 at"):
        load_clip(path)
