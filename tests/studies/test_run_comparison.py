"""Runs compared by what they predict of the same motion."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from fitting.cli import main
from fitting.inference.sampling import blocks
from fitting.inference.sampling.blocks import BlockLogLikelihood
from fitting.studies import run_folder
from fitting.studies.posterior.run_comparison import compare_runs
from support.pages import Page
from support.refusals import refusal

pytest.importorskip("arviz_stats")
GOOD = np.array([-3.0, -2.0, -4.0, -3.5, -2.5, -3.0])
LOSS = np.array([1.0, 1.5, 0.5, 1.2, 0.8, 1.0])  # of the other system, block by block


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """Folders of runs need no fit here; b predicts better than a."""
    monkeypatch.setattr(run_folder, "load_fit", lambda folder: None)
    monkeypatch.chdir(tmp_path)
    write_run(Path("a"), GOOD - LOSS)
    write_run(Path("b"), GOOD)
    return tmp_path


def write_run(folder: Path, level: np.ndarray, data: str = "aaaa", draws: int = 200) -> None:
    """A sampled run whose blocks have this log-likelihood, within 0.1."""
    folder.mkdir()
    values = level + 0.1 * np.random.default_rng(0).normal(size=(draws, len(level)))
    clip = np.array([1, 1, 1, 1, 2, 2])
    start = np.array([0.0, 1.0, 2.0, 3.0, 0.0, 1.0])
    given = BlockLogLikelihood(values, clip, start, start + 1.0, data, 1.0)
    blocks.to_tree(given).to_netcdf(folder / run_folder.INFERENCE_DATA, engine="h5netcdf")


def test_the_run_that_predicts_better_comes_first_with_the_difference():
    first, second = compare_runs([Path("a"), Path("b")])
    assert (first.name, second.name) == ("b", "a")
    assert first.elpd == pytest.approx(GOOD.sum(), abs=0.1)
    assert (first.behind, first.behind_error) == (0.0, 0.0)
    assert second.behind == pytest.approx(LOSS.sum(), abs=0.01)
    assert second.behind_error == pytest.approx(np.sqrt(6) * LOSS.std(ddof=1), rel=0.01)
    assert second.error > second.behind_error  # what blocks share does not count
    assert sum(first.clips.values()) == pytest.approx(first.elpd)
    assert first.clips[2] == pytest.approx(GOOD[4:].sum(), abs=0.1)


def test_the_command_prints_and_writes_the_table(capsys):
    assert main.main(["compare", "--runs", "a,b", "-o", "compared"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("b ") and lines[3].startswith("a ")
    assert "elpd of clip 2" in lines[0]
    text = Path("compared/runs.md").read_text()
    assert "| a | " in text and "expected log predictive density" in text
    page = Page(Path("compared") / run_folder.PAGE)
    assert "b predicts best; a is 6.0 ± 0.8 below." in page.text
    rows = json.loads(Path("compared/runs.json").read_text())
    assert [row["name"] for row in rows] == ["b", "a"]
    assert main.main(["compare", "--runs", "a,b"]) == 0
    assert "written" not in capsys.readouterr().out


def test_runs_that_cannot_be_compared_are_refused(folder, capsys):
    write_run(Path("other"), GOOD, data="bbbb")
    write_run(Path("few"), GOOD, draws=50)
    Path("none").mkdir()
    for words, message in (
        ("--runs a", "wanted two or more different ones"),
        ("--runs a,a", "wanted two or more different ones"),
        ("--runs a,other", "a and other were fitted to different motion"),
        ("--runs a,few", "few: 50 draws of 6 blocks"),
        ("--runs a,none", "none: no posterior.nc; `jaxik sample none` makes it"),
        ("--runs a,b --presets ozz", "--presets and --runs exclude each other"),
        ("walk.bvh --runs a,b", "CLIP is walk.bvh; runs are compared on the clips of"),
        ("--runs a,b --suite", "--runs and --suite exclude each other"),
    ):
        assert message in refusal(["compare", *words.split()], folder, capsys)


def changed(change: Callable[[Any], object]) -> Callable[[Path], None]:
    """A change of the file as HDF5 has it."""

    def damage(path: Path) -> None:
        with h5py.File(path, "a") as file:
            change(file)

    return damage


def set_nan(file: Any) -> None:
    file["log_likelihood"]["motion"][0, 3, 2] = np.nan


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_bytes(b""), "no log-likelihood in it"),
        (lambda path: path.write_bytes(bytes(range(256)) * 8), "no log-likelihood in it"),
        (lambda path: path.write_bytes(path.read_bytes()[:-999]), "no log-likelihood in it"),
        (changed(lambda file: file.pop("log_likelihood")), "Could not find node"),
        (changed(lambda file: file["log_likelihood"].pop("clip")), "in it: .*clip"),
        (changed(set_nan), "values has numbers that are not finite"),
        (changed(lambda file: file.attrs.create("format", 9)), "format is 9"),
        (changed(lambda file: file.attrs.create("format", "x")), "in it"),
    ],
)
def test_a_damaged_log_likelihood_is_named(folder, capsys, damage, message):
    damage(folder / "b" / run_folder.INFERENCE_DATA)
    line = refusal(["compare", "--runs", "a,b"], folder, capsys)
    assert "b/posterior.nc" in line and re.search(message, line), line
