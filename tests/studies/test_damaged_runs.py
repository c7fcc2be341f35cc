"""Folders in which something is damaged, or whose disk is full: one sentence names what.

Nothing that was whole is changed.
"""

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import matplotlib.pyplot as plt
import numpy as np
import pytest

from fitting.cli import main
from fitting.experiments import problems
from fitting.inference.sampling.chain import Chain
from fitting.inference.sampling.chain_file import Identity
from fitting.inference.sampling.posterior import digest
from fitting.runtime import files
from fitting.runtime.storage.claimed_folder import claimed
from fitting.studies import run_folder
from fitting.studies.fit import Fit
from fuzz import kept_files
from support import quick, small_studies
from support.experiments import ROOT, write
from support.refusals import refusal
from support.runs import NAMES, invented_fit, save
from support.small_studies import HALF_SECOND

Damage: TypeAlias = Callable[[Path], object]
DATA = ROOT / "data"
CLIP_FILES = [DATA / "clips/uneven_walk_base.npz", "--terrain", DATA / "terrains/uneven_walk.ply"]
WHOLE_FILES = {
    "cut in half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "zeros": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
    "a file in it": lambda path: (path.unlink(), path.mkdir(), (path / "x").write_text("x")),
    "missing": Path.unlink,
}
GOES_ON = {("chain.h5", "missing"), ("fit.json", "missing")}  # a new chain; parameters alone


@pytest.fixture(scope="module")
def sampled(tmp_path_factory) -> Path:
    """A run with its chain, of residuals that compile at once."""
    folder = tmp_path_factory.mktemp("sampled")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
        patch.setattr(Fit, "groups", [])  # they would take the pipeline
        fitted = invented_fit(folder, "[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 6")
        save(folder / "run", fitted)
    settings, random = fitted.experiment.sample, np.random.RandomState(0)
    identity = Identity(NAMES, 8, fitted.experiment.seed, settings.thin_by, digest(fitted.problem))
    with Chain(identity, folder / "run" / run_folder.CHAIN) as chain:
        for _ in range(6):
            state: Any = random.get_state()
            chain.append(random.normal(size=(8, 2)), np.zeros(8), np.ones(8, bool), state)
    return folder / "run"


@pytest.fixture
def run(sampled, tmp_path, monkeypatch) -> Path:
    """A copy, to be damaged."""
    monkeypatch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
    return shutil.copytree(sampled, tmp_path / "run")


def sampling_refused(run: Path, capsys) -> str:
    return refusal(["sample", run], run, capsys)


def applying_refused(run: Path, capsys) -> str:
    words = ["apply", run, *CLIP_FILES, "-o", run.parent / "out.npz"]
    return refusal(words, run.parent, capsys)


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        pytest.param(name, damage, id=f"{name} {kind}")
        for name in ("experiment.toml", "fit.json", "parameters.toml", "chain.h5")
        for kind, damage in WHOLE_FILES.items()
        if (name, kind) not in GOES_ON
    ],
)
def test_a_file_that_is_damaged_as_a_whole_is_named(run, name, damage, capsys):
    damage(run / name)
    applied = name in ("fit.json", "parameters.toml")  # all that `apply` reads
    refused = applying_refused if applied else sampling_refused
    assert name in refused(run, capsys)


def in_fit(change: Callable[[dict[str, Any]], object]) -> Damage:
    """A change to the content of fit.json."""

    def damage(run: Path) -> None:
        numbers = json.loads((run / "fit.json").read_text())
        change(numbers)
        (run / "fit.json").write_text(json.dumps(numbers))

    return damage


def of_row(**changes: object) -> Damage:
    return in_fit(lambda numbers: numbers["parameters"][0].update(changes))


NUMBERS = {
    "far away": (of_row(u=1e9), r"parameters[0].u is 1000000000.0; wanted a number from -40 to 40"),
    "NaN": (of_row(u=float("nan")), "parameters[0].u is nan"),
    "text": (of_row(u="0.1"), "parameters[0].u is '0.1'; wanted a number"),
    "no width": (of_row(start_sd=0.0), "parameters[0].start_sd is 0.0; wanted"),
    "list": (of_row(value=[0.1]), "parameters[0].value is [0.1]; wanted a number"),
    "kind": (of_row(kind="cubic"), "parameters[0].kind is 'cubic'"),
    "interval": (of_row(interval=[1.0]), "parameters[0].interval is [1.0]; wanted a list of 2"),
    "valleys": (of_row(valleys=[{"value": 1.0}]), "parameters[0].valleys[0] has no interval"),
    "same names": (of_row(name="foot.max_pitch"), "wanted one or more, each once"),
    "other names": (of_row(name="pelvis.limit"), "the fit has the parameters"),
    "key": (in_fit(lambda n: n["parameters"][1].pop("u")), "parameters[1] has no u"),
    "no table": (lambda run: (run / "fit.json").write_text("[]"), "not the numbers of a fit"),
    "no rows of a table": (in_fit(lambda n: n.update(parameters=[3])), "not the numbers of a fit"),
    "rows": (in_fit(lambda n: n.update(parameters=[])), "its parameters are []"),
    "no rows": (in_fit(lambda n: n.pop("parameters")), "it has no parameters"),
    "noise": (in_fit(lambda n: n.update(noise={"sigmas": {}})), "noise has no correlations"),
    "newer": (in_fit(lambda n: n.update(format=9)), "its format is 9; this release reads"),
}  # fmt: skip


@pytest.mark.parametrize(("damage", "message"), NUMBERS.values(), ids=NUMBERS)
def test_a_wrong_number_of_a_fit_is_named(run, damage, message, capsys):
    damage(run)
    assert message in sampling_refused(run, capsys)


def test_keys_of_a_later_release_do_no_harm(run):
    of_row(colour="red")(run)
    assert run_folder.load_fit(run)[1]["parameters"][0]["name"] == "pelvis.on_gain"


@pytest.mark.parametrize("name", [run_folder.EXPERIMENT, run_folder.PARAMETERS])
def test_a_toml_file_of_a_newer_format_is_refused(run, name, capsys):
    text = (run / name).read_text()
    assert text.startswith("# jaxik run, format 1\n")
    (run / name).write_text(text.replace("format 1", "format 9", 1))
    refused = applying_refused if name == run_folder.PARAMETERS else sampling_refused
    line = refused(run, capsys)
    assert f"{name}: its format is 9; this release reads formats up to 1" in line


def test_a_system_without_a_fitted_parameter_is_not_applied(run, capsys):
    (run / run_folder.PARAMETERS).write_text('preset = "record"\n')
    line = applying_refused(run, capsys)
    assert "no foot.max_pitch, pelvis.on_gain; `jaxik fit` makes a run" in line


def in_chain(change: Callable[[Any], object]) -> Damage:
    """A change to the group of chain.h5."""

    def damage(run: Path) -> None:
        with h5py.File(run / "chain.h5", "a") as file:
            change(file["mcmc"])

    return damage


def with_array(name: str, array: np.ndarray) -> Damage:
    def change(group: Any) -> None:
        del group[name]
        group[name] = array

    return in_chain(change)


def set_nan(group: Any) -> None:
    group["chain"][3, 2, 0] = np.nan


CHAINS = {
    "another shape": (with_array("chain", np.zeros((6, 8, 3))), "chain is float64 (6, 8, 3)"),
    "too few axes": (with_array("chain", np.zeros(6)), "chain is float64 (6,); wanted numbers"),
    "a number": (with_array("chain", np.zeros(())), "chain is float64 ()"),
    "text": (with_array("chain", np.full((6, 8, 2), b"x")), "chain is |S1 (6, 8, 2)"),
    "other length": (with_array("log_prob", np.zeros((5, 8))), "log_prob is float64 (5, 8)"),
    "other walkers": (with_array("accepted", np.zeros(9)), "accepted is float64 (9,)"),
    "NaN": (in_chain(set_nan), "chain has numbers that are not finite"),
    "no state": (in_chain(lambda g: g.attrs.pop("random_state_1")), "no random_state_1"),
    "short state": (
        in_chain(lambda g: g.attrs.create("random_state_1", np.zeros(3, int))), "state of 3 keys"
    ),
    "type": (in_chain(lambda g: g.attrs.create("walkers", "many")), "invalid literal"),
    "names": (in_chain(lambda g: g.attrs.create("parameters", 3)), "its parameters is ('3',)"),
    "array": (in_chain(lambda g: g.attrs.create("seed", [1, 2])), "is not a chain"),
    "no names": (in_chain(lambda g: g.attrs.pop("parameters")), "'parameters'"),
    "no array": (in_chain(lambda g: g.pop("log_prob")), "log_prob"),
    "group": (in_chain(lambda g: (g.pop("chain"), g.create_group("chain"))), "is not a chain"),
    "newer": (in_chain(lambda g: g.attrs.create("format", 9)), "its format is 9; this release"),
}  # fmt: skip


@pytest.mark.parametrize(("damage", "message"), CHAINS.values(), ids=CHAINS)
def test_a_damaged_chain_is_named_and_stays(run, damage, message, capsys):
    damage(run)
    line = sampling_refused(run, capsys)
    assert "chain.h5" in line and message in line


def test_a_chain_with_a_few_other_bytes_is_named_before_hdf5_reads_it(run, capsys):
    path, random = run / run_folder.CHAIN, np.random.default_rng(0)
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    for place in random.integers(len(whole) - 20, size=6):
        damaged = whole.copy()
        damaged[place] ^= 1 << random.integers(8)
        path.write_bytes(damaged.tobytes())
        line = sampling_refused(run, capsys)
        assert "chain.h5 is not a chain of this sampler: its bytes are not those that" in line


def test_a_run_that_another_process_samples_is_left_alone(run, capsys):
    with claimed(run):
        line = sampling_refused(run, capsys)
    assert f"{run}: in use by process" in line


# What studies keep

KEPT = {
    "contribution.json": (kept_files.rows_text(), kept_files.load_rows, "ablate"),
    "searches/0123.json": (kept_files.found_text(), kept_files.load_found, "population"),
    **{
        f"{kind}/0000.json": (kept_files.text_of(whole), kept_files.load_replicate, "calibrate")
        for kind, whole in kept_files.REPLICATES.items()
    },
}
NOT_KEPT = {"{": "not JSON", "[]": "wanted a table", "{}": "it has no ", "[" * 10**5: "not JSON"}
CHANGED = [
    ("contribution.json", {"rows": [3]}, "rows[0] is 3"),
    ("searches/0123.json", {"u": [0.0]}, "u has 1 numbers; wanted 2"),
    ("searches/0123.json", {"u": [0.0, float("nan")]}, "u[1] is nan; wanted a finite number"),
    ("searches/0123.json", {"cost": "low"}, "cost is 'low'; wanted a number"),
    ("searches/0123.json", {"noise": {"sigmas": {}}}, "noise has no correlations"),
    ("fits/0000.json", {"number": 3}, "it is of replicate 3"),
    ("fits/0000.json", {"truth": [0.1, 0.2]}, "its lists have different lengths"),
    ("fits/0000.json", {"parameters": []}, "parameters has []; wanted"),
    ("chains/0000.json", {"ranks": {"lean.gain": 3}}, "ranks has "),
    ("chains/0000.json", {"intervals": {}}, "intervals has []; wanted"),
    ("chains/0000.json", {"format": 9}, "its format is 9"),
]


@pytest.mark.parametrize("name", KEPT)
def test_a_kept_result_that_is_damaged_is_named(name, tmp_path):
    whole, load, command = KEPT[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    changes = [(change, message) for changed, change, message in CHANGED if changed == name]
    texts = {json.dumps(json.loads(whole) | change): message for change, message in changes}
    for text, message in {**NOT_KEPT, **texts}.items():
        path.write_text(text)
        with pytest.raises(ValueError) as refused:
            load(path)
        assert str(refused.value).startswith(f"{path}: ") and message in str(refused.value), text
        assert f"`jaxik {command}`" in str(refused.value) or "format" in message, text
        assert path.read_text() == text
    path.write_bytes(whole)
    load(path)


# Full disks

FULL = "cannot be written: No space left on device"
STATE: Any = np.random.RandomState(0).get_state()
IDENTITY = Identity(("a", "b"), walkers=8, seed=0, thin_by=1, problem="x" * 64)


@pytest.fixture
def disk(tmp_path) -> Iterator[Path]:
    """A file system of 64 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(words, capture_output=True).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("only root may mount a disk")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_without_room_is_named_and_the_old_one_stays(disk):
    figure, axes = plt.subplots()
    axes.imshow(np.random.default_rng(0).random((300, 300)))
    fills = {
        "notes.txt": lambda path: path.write_text("x" * 100_000),
        "clip.npz": lambda path: np.savez(path, a=np.zeros(20_000)),
        "plot.png": lambda path: figure.savefig(path, dpi=200),
    }
    for name, fill in fills.items():
        files.write_text(disk / name, "old")
        with pytest.raises(ValueError, match=f"{name}: {FULL}"):
            files.write(disk / name, fill)
        assert (disk / name).read_text() == "old"
    plt.close(figure)
    assert names(disk) == sorted(fills)


def extend(chain: Chain, steps: int) -> None:
    for _ in range(steps):
        u = np.full((8, 2), float(len(chain)))
        chain.append(u, np.zeros(8), np.ones(8, bool), STATE)


def test_a_chain_without_room_keeps_the_steps_that_had_some(disk):
    path = disk / "chain.h5"
    with pytest.raises(ValueError, match=f"chain.h5: {FULL}"), Chain(IDENTITY, path) as chain:
        extend(chain, 1000)
    assert names(disk) == ["chain.h5", "chain.h5.journal"]
    with pytest.raises(ValueError, match=f"chain.h5: {FULL}"), Chain(IDENTITY, path):
        pass
    subprocess.run(["mount", "-o", "remount,size=1m", str(disk)], check=True)
    with Chain(IDENTITY, path) as chain:
        assert 10 < len(chain) < 1000
        assert (chain.u[:, 0, 0] == np.arange(len(chain))).all()
        extend(chain, 1)
    assert names(disk) == ["chain.h5"]


def test_a_fit_without_room_leaves_no_folder(disk, tmp_path, monkeypatch, capsys):
    small_studies.quick_fits(monkeypatch)
    path = write(tmp_path, clips=HALF_SECOND)
    (disk / "full").write_bytes(bytes(60_000))
    assert main.main(["fit", str(path), "-o", str(disk / "runs" / "walk")]) == main.MISTAKE
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith(f"jaxik fit: {disk}/runs/walk/") and line.endswith(FULL)
    assert names(disk) == ["full"]
