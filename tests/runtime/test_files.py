"""Files are written completely or not at all."""

import os
import stat

import pytest

from fitting.runtime import files


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_text_replaces_the_one_before(tmp_path):
    path = tmp_path / "notes.md"
    files.write_text(path, "first")
    files.write_text(path, "half-life 0.2 s, π")
    assert path.read_text(encoding="utf-8") == "half-life 0.2 s, π"
    assert names(tmp_path) == ["notes.md"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failure_while_writing_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "clip.npz"
    files.write_text(path, "intact")

    def fill(temporary):
        temporary.write_text("ha")
        raise error

    with pytest.raises(error):
        files.write(path, fill)
    assert path.read_text() == "intact" and names(tmp_path) == ["clip.npz"]


def test_the_temporary_file_is_in_the_same_folder_with_the_same_suffix(tmp_path):
    paths = []
    files.write(tmp_path / "plot.png", lambda path: (paths.append(path), path.write_text("x")))
    assert paths[0].parent == tmp_path and paths[0].suffix == ".png" and not paths[0].exists()


def test_a_file_has_the_permissions_of_any_new_file(tmp_path):
    mask = os.umask(0o027)
    try:
        files.write_text(tmp_path / "shared.txt", "x")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "shared.txt").stat().st_mode) == 0o640


def test_an_impossible_path_is_rejected_before_anything_is_computed(tmp_path):
    (tmp_path / "run").mkdir()

    def fill(path):
        raise AssertionError("called")

    with pytest.raises(ValueError, match="run: cannot be written: it is a folder"):
        files.write(tmp_path / "run", fill)
    with pytest.raises(ValueError, match=r"a\.npz: cannot be written: there is no folder .*no"):
        files.write(tmp_path / "no" / "a.npz", fill)
    assert names(tmp_path) == ["run"]


def test_an_error_of_the_system_is_reported_with_the_file(tmp_path, monkeypatch):
    def refuse(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.tempfile, "mkstemp", refuse)
    with pytest.raises(ValueError, match=r"a\.txt: cannot be written: Permission denied"):
        files.write_text(tmp_path / "a.txt", "x")
