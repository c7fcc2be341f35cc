"""Commands of studies that are refused: one line says why, before anything is run or written."""

import os
import shlex
from pathlib import Path

import pytest

import fitting
from fitting.experiment import problems
from fitting.runtime.claimed_folder import claimed
from support import quick, small_studies
from support.commands import refusal
from support.experiments import FREE, ROOT, write
from support.small_studies import HALF_SECOND, VARYING

BASE = ROOT / "data" / "clips" / "uneven_walk_base.npz"
GROUND = ROOT / "data" / "terrains" / "uneven_walk.ply"
FILES = {
    "file": "",
    "liar.toml": 'preset = "record"\npelvis.speed = 3.0\n',
    "free.toml": "[free]\npelvis.limit = { hihg = 1.0 }\n",
    "none.toml": "[fre]\nx = 1\n",
    "noisy.toml": '[free]\npelvis.limit = {}\n[noise]\nsigmas = "estimated"\n',
    "noisy_system.toml": 'preset = "ozz"\n[noise]\ncorrelation = "whitened"\n',
    "legs.toml": "foot.max_roll = [1, 2, 3]",
    "record.toml": "lock.enabled = false\n",
    "as animated.toml": "lock.enabled = false\n",
}
COMPARE = f"compare {BASE} --terrain {GROUND} -o d"
# Of options that occur twice, the last counts.
TRANSLATE = f"translate --from record --to record --clip {BASE} --terrain {GROUND} -o run"
REFUSED = [
    (COMPARE, "nothing to compare; wanted --presets or --parameters"),
    (f"{COMPARE} --presets ''", "--presets '': wanted names with commas between them"),
    (f"{COMPARE} --presets record,", "--presets 'record,': wanted names"),
    (f"{COMPARE} --presets record,none", "no preset named 'none'; there are"),
    (f"{COMPARE} --presets record,record", "already is a system named 'record'"),
    (f"{COMPARE} --presets record --parameters record.toml", "system named 'record'"),
    (f"{COMPARE} --parameters 'as animated.toml'", "system named 'as animated'"),
    (f"{COMPARE} --parameters legs.toml", "legs: foot.max_roll has shape (3,)"),
    ("compare", "required: CLIP, --terrain, -o/--output; or --suite"),
    ("compare walk.bvh", "required: --terrain, -o/--output; or --suite"),
    ("compare --suite walk.bvh", "CLIP is walk.bvh; the suite has animations and grounds"),
    ("compare --suite --terrain a.obj", "--terrain is a.obj; the suite has"),
    ("compare --suite --root ground", "--root is ground; the suite has"),
    ("compare --suite --only stairs", "--only 'stairs': no such situation; there are flat wa"),
    ("compare --quick walk.bvh", "--quick belongs to --suite"),
    (f"{TRANSLATE} --from recrod", "--from takes a preset or a parameter .toml: no preset named"),
    (f"{TRANSLATE} --to recrod", "--to takes a preset or a parameter .toml: no preset named 'rec"),
    (f"{TRANSLATE} --to liar.toml", "liar.toml: unknown key 'pelvis.speed'; nearest is"),
    (f"{TRANSLATE} --terrain {GROUND}", "1 clip(s) and 2 terrain(s); wanted a terrain for each"),
    (f"{TRANSLATE} --free pelvis.limti", "--free pelvis.limti: no parameter named 'pelvis.limti'"),
    (f"{TRANSLATE} --free ,", "--free ,: names no parameter"),
    (f"{TRANSLATE} --free free.toml", "free.toml [free] pelvis.limit: unknown key 'hihg'"),
    (f"{TRANSLATE} --free none.toml", "none.toml: unknown key 'fre'; nearest is 'free'"),
    (f"{TRANSLATE} --free noisy.toml", "noisy.toml: there is a table [noise], but nothing"),
    (f"{TRANSLATE} --from noisy_system.toml", "reference of a translation is exact"),
    (f"{TRANSLATE} -o full", "full: there is something in it already: ['kept']"),
    ("init a.npz b.npz c.npz --terrain a b -o new", "3 clip(s) and 2 terrains; wanted"),
    ("init a.npz b.npz --base a -o new", "2 clip(s) and 1 base(s); wanted none, or one"),
    ("init a.npz --preset ozz --record-only -o new", "of the preset 'record', not 'ozz'"),
    ("init a.npz --preset nobody -o new", "no preset named 'nobody'"),
    ("init a.bvh --terrain-scale 0.01 -o new", "no --terrain that the options of terrains could"),
    ("init a.npz --scale 0.01 -o new", "the clips: scale is of no use: an .npz states"),
    ("fit-many experiment.toml -o full", "something in it already: ['kept']"),
    ("ablate experiment.toml -o d --folds 30", "foot never stands; take fewer"),
]


@pytest.mark.parametrize(("line", "message"), REFUSED)
def test_a_mistake_is_one_line_and_nothing_is_written(line, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("full").mkdir()
    Path("full/kept").touch()
    for name, text in FILES.items():
        Path(name).write_text(text)
    write(tmp_path, clips=HALF_SECOND)
    assert message in refusal(shlex.split(line), tmp_path, capsys)


@pytest.mark.parametrize("command", ["fit", "ablate", "calibrate", "population", "fit-many"])
def test_a_second_command_in_a_folder_is_refused(tmp_path, command, capsys, monkeypatch):
    small_studies.quick_fits(monkeypatch)
    path, folder = write(tmp_path, clips=HALF_SECOND), tmp_path / "run"
    with claimed(folder):
        line = refusal([command, path, "-o", folder], tmp_path, capsys)
    assert f"{folder}: in use by process {os.getpid()} on " in line and not folder.exists()


def test_what_does_not_vary_smoothly_makes_no_population(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_references)
    threshold = "contact.planted_height"
    for rest, free, message in (
        ("", FREE, "nothing varies between the clips; name free parameters in the table [hier"),
        (VARYING.replace("pelvis.half_life", threshold), f"{threshold} = {{}}", "is a threshold: "),
    ):
        path = small_studies.write_population(tmp_path, rest, free=free)
        words = ["population", path, "-o", tmp_path / "out"]
        assert message in refusal(words, tmp_path, capsys, silent=False)


@pytest.mark.parametrize(
    ("job", "options", "message"),
    [
        (fitting.ablate, {"folds": 1}, "folds is 1; wanted 2 or more"),
        (fitting.calibrate, {"noise_factor": 0.0}, "noise_factor is 0; wanted a positive number"),
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
