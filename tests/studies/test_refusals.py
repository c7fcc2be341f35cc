"""Commands of studies that are refused: one line says why, before anything is run or written."""

from pathlib import Path

import pytest

import fitting
from fitting.experiments import problems
from support import quick, small_studies
from support.experiments import FREE, ROOT, write
from support.refusals import refusal
from support.small_studies import HALF_SECOND

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
THRESHOLD = '[hierarchy]\nper_clip = ["contact.planted_height"]\n'
FILES = {
    "file": "",
    "legs.toml": "foot.max_roll = [1, 2, 3]",
    "liar.toml": 'preset = "record"\npelvis.speed = 3.0\n',
    "free.toml": "[free]\npelvis.limit = { hihg = 1.0 }\n",
    "none.toml": "[fre]\nx = 1\n",
    "noisy.toml": '[free]\npelvis.limit = {}\n[noise]\nsigmas = "estimated"\n',
    "noisy_system.toml": 'preset = "ozz"\n[noise]\ncorrelation = "whitened"\n',
    "record.toml": "lock.enabled = false\n",
    "as animated.toml": "lock.enabled = false\n",
}


def compare(*more: object, clip: object = BASE) -> list[object]:
    return ["compare", clip, "--terrain", GROUND, "-o", "d", *more]


def translate(*more: object) -> list[object]:
    """Of options that occur twice, the last counts."""
    words = ["--from", "record", "--to", "record", "--clip", BASE, "--terrain", GROUND]
    return ["translate", *words, "-o", "run", *more]


def suite(*more: object) -> list[object]:
    return ["compare", *more]


def init(*words: object) -> list[object]:
    return ["init", *words, "-o", "new"]


REFUSED = [
    (compare("--presets", "record", clip="no.npz"), "no.npz: no such file"),
    (compare("--presets", "record", "--terrain", "no.ply"), "no.ply: no such file"),
    (compare("--presets", "record", "-o", "file"), "file: no folder can be made here"),
    (compare("--presets", "record", "-o", "file/d"), "file is a file"),
    (compare(), "nothing to compare; wanted --presets or --parameters"),
    (compare("--presets", ""), "--presets '': wanted names with commas between them"),
    (compare("--presets", "record,"), "--presets 'record,': wanted names"),
    (compare("--presets", "record,none"), "no preset named 'none'; there are"),
    (compare("--presets", "record,record"), "already is a system named 'record'"),
    (compare("--presets", "record", "--parameters", "record.toml"), "system named 'record'"),
    (compare("--parameters", "as animated.toml"), "system named 'as animated'"),
    (compare("--parameters", "no.toml"), "no.toml: no such file, wanted a parameter file"),
    (compare("--parameters", "none.toml"), "none.toml: unknown key 'fre'"),
    (compare("--parameters", "legs.toml"), "legs: foot.max_roll has shape (3,)"),
    (suite(), "required: CLIP, --terrain, -o/--output; or --suite"),
    (suite("walk.bvh"), "required: --terrain, -o/--output; or --suite"),
    (suite("--suite", "walk.bvh"), "CLIP is walk.bvh; the suite has animations and grounds"),
    (suite("--suite", "--terrain", "a.obj"), "--terrain is a.obj; the suite has"),
    (suite("--suite", "--root", "ground"), "--root is ground; the suite has"),
    (suite("--suite", "--only", "stairs"), "--only 'stairs': no such situation; there are flat wa"),
    (suite("--suite", "--presets", "recrod"), "no preset named 'recrod'; there are"),
    (suite("--quick", "walk.bvh"), "--quick belongs to --suite"),
    (suite("--only", "hill", "walk.bvh"), "--only belongs to --suite"),
    (translate("--from", "recrod"), "--from takes a preset or a parameter .toml: no preset named"),
    (
        translate("--to", "recrod"),
        "--to takes a preset or a parameter .toml: no preset named 'recrod'",
    ),
    (translate("--to", "no.toml"), "no.toml: no such file, wanted a parameter file"),
    (translate("--to", "liar.toml"), "liar.toml: unknown key 'pelvis.speed'; nearest is"),
    (translate("--terrain", GROUND), "1 clip(s) and 2 terrain(s); wanted a terrain for each clip"),
    (
        translate("--free", "pelvis.limti"),
        "--free pelvis.limti: no parameter named 'pelvis.limti'; near",
    ),
    (translate("--free", ","), "--free ,: names no parameter"),
    (translate("--free", "free.toml"), "free.toml [free] pelvis.limit: unknown key 'hihg'"),
    (translate("--free", "none.toml"), "none.toml: unknown key 'fre'; nearest is 'free'"),
    (translate("--free", "noisy.toml"), "noisy.toml: there is a table [noise], but nothing"),
    (translate("--from", "noisy_system.toml"), "reference of a translation is exact"),
    (translate("-o", "full"), "full: there is something in it already: ['kept']"),
    (translate("-o", "file"), "is a file"),
    (init("a.npz", "b.npz", "c.npz", "--terrain", "a", "b"), "3 clip(s) and 2 terrains; wanted"),
    (init("a.npz", "b.npz", "--base", "a"), "2 clip(s) and 1 base(s); wanted none, or one"),
    (init("a.npz", "--preset", "ozz", "--record-only"), "made of the preset 'record', not 'ozz'"),
    (init("a.npz", "--preset", "nobody"), "no preset named 'nobody'"),
    (init("a.npz"), "a.npz: no such file"),
    (init("a.bvh", "--terrain-scale", "0.01"), "no --terrain that the options of terrains could"),
    (init("a.npz", "--scale", "0.01"), "the clips: scale is of no use: an .npz states"),
    (["fit-many", "experiment.toml", "-o", "full"], "something in it already: ['kept']"),
    (["ablate", "experiment.toml", "-o", "d", "--folds", "30"], "foot never stands; take fewer"),
]


@pytest.mark.parametrize(("words", "message"), REFUSED)
def test_a_mistake_is_one_line_and_nothing_is_written(
    words, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    Path("full/kept").touch()
    for name, text in FILES.items():
        Path(name).write_text(text)
    write(tmp_path, clips=HALF_SECOND)
    assert message in refusal(words, tmp_path, capsys)


@pytest.mark.parametrize(
    ("rest", "free", "message"),
    [
        ("", FREE, "nothing varies between the clips; name free parameters in the table [hier"),
        (THRESHOLD, "contact.planted_height = {}", "is a threshold: residuals jump with it"),
    ],
)
def test_what_does_not_vary_smoothly_makes_no_population(
    rest, free, message, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_references)
    path = small_studies.write_population(tmp_path, rest, free=free)
    words = ["population", path, "-o", tmp_path / "out"]
    assert message in refusal(words, tmp_path, capsys, silent=False)


@pytest.mark.parametrize(
    ("job", "options", "message"),
    [
        (fitting.ablate, {"folds": 1}, "folds is 1; wanted 2 or more"),
        (fitting.ablate, {"folds": -2}, "folds is -2; wanted 2 or more"),
        (fitting.calibrate, {"noise_factor": 0.0}, "noise_factor is 0; wanted a positive number"),
        (fitting.calibrate, {"noise_factor": -1.0}, "noise_factor is -1; wanted a positive num"),
        (fitting.calibrate, {"replicates": 0}, "replicates is 0; wanted 1 or more"),
        (fitting.fit_many, {"seeds": 0, "workers": 0}, "seeds is 0; wanted 1 to"),
        (fitting.fit_many, {"workers": -1}, "workers is -1; wanted 0"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(job, options, message, tmp_path):
    path = write(tmp_path, clips=HALF_SECOND)
    with pytest.raises(ValueError, match=message):
        job(path, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_no_experiments_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no experiments; wanted one or more"):
        fitting.fit_many([], tmp_path / "out")
