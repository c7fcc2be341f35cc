"""The commands that explain: `parameters`, `schema`, `example`, `completion`."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest

from fitting.cli import main, without_jax
from fitting.cli.commands import COMMANDS
from fitting.cli.parsers.guides import SHELLS
from fitting.experiments import systems
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.schema.experiment_schema import experiment_schema
from fitting.jobs import examples
from jaxik.maths import parameter_tree
from support.commands import commands
from support.refusals import refusal

shtab = pytest.importorskip("shtab")


@pytest.mark.parametrize("preset", systems.preset_names())
def test_parameters_lists_every_one_with_its_declaration(preset, capsys):
    assert main.main(["parameters", preset, "--format", "json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    ik = systems.preset_system(preset)
    assert list(rows) == [*parameter_tree.docs(ik)]
    for name, declared in parameter_tree.declarations(ik).items():
        shown = {key: rows[name][key] for key in ("low", "high", "unit", "kind")}
        assert shown == {key: getattr(declared, key) for key in shown}
        assert rows[name]["meaning"] == declared.doc


def test_parameters_shows_the_defaults_of_the_preset_and_of_its_original(capsys):
    main.main(["parameters", "ozz", "--search", "Pelvis.LIMIT"])
    assert "pelvis.limit  inf m    0 to 0.6  Furthest that" in capsys.readouterr().out
    main.main(["parameters", "record", "--faithful", "--format", "markdown"])
    assert "| contact.planted_height |" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["parameters", "walker"], "no preset named 'walker'; there are ['mec', "),
        (["parameters", "stride", "--faithful"], "no other original"),
        (["parameters", "--search", "elbow"], "no parameter of record mentions 'elbow'"),
        (["example", "uneven"], "nearest is 'uneven_walk' of ["),
        (["example", "-o", "walk"], "needs the NAME"),
    ],
)
def test_a_mistake_costs_one_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(words, tmp_path, capsys)


def test_schema_is_written_as_json_and_lists_every_key(tmp_path, capsys):
    path = tmp_path / "experiment.schema.json"
    assert main.main(["schema", "--format", "json", "-o", str(path)]) == 0
    assert json.loads(path.read_text(encoding="utf-8")) == experiment_schema()
    capsys.readouterr()
    assert main.main(["schema", "--format", "markdown"]) == 0
    rows = capsys.readouterr().out
    for key in ("fps", "clips.mask_pops", "fit.search.population", "rules.pelvis", "prior.spread"):
        assert f"| {key} | " in rows
    assert "| true, false | true | Whether frames in which a captured marker jumps" in rows


def test_example_lists_experiments_by_title(capsys):
    assert main.main(["example"]) == 0
    out = capsys.readouterr().out
    assert "uneven_walk" in out and "stop and go, ozz" in out
    # Those whose clips are not in the repository.
    elsewhere = {"blocks", "blocks_walk", "blocks_causal"}
    assert len(examples.names().keys() - elsewhere) == 11


@pytest.mark.parametrize("name", ["uneven_walk", "calibration/ozz_noise"])
def test_a_copied_example_is_whole_and_names_its_schema(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main.main(["example", name, "-o", "copy"]) == 0
    path = tmp_path / "copy" / f"{Path(name).name}.toml"
    loaded, original = load_experiment(path), load_experiment(examples.path_of(name))
    for part in ("free", "prior", "sigmas"):
        assert getattr(loaded, part) == getattr(original, part)
    for clip, source in zip(loaded.clips, original.clips, strict=True):
        assert clip.reference.is_relative_to(tmp_path)
        assert clip.reference.read_bytes() == source.reference.read_bytes()
        assert clip.terrain.read_bytes() == source.terrain.read_bytes()
    text = path.read_text(encoding="utf-8")
    schema = path.parent / text.splitlines()[0].removeprefix("#:schema ")
    jsonschema.validate(tomllib.loads(text), json.loads(schema.read_text(encoding="utf-8")))
    assert main.main(["example", name, "-o", "copy"]) == main.MISTAKE
    assert "is already there" in capsys.readouterr().err


SCRIPT = """
source jaxik.bash
function=$(complete -p jaxik | sed 's/.*-F \\([^ ]*\\).*/\\1/')
cd "$1"
while IFS='|' read -ra COMP_WORDS; do
    COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); COMPREPLY=()
    $function
    echo "${COMPREPLY[@]}"
done
"""
COMPLETED = {
    "jaxik para": {"parameters"},
    "jaxik parameters --format ": {"text", "markdown", "json"},
    "jaxik record to-": {"to-toml", "to-bytes"},
    "jaxik fit uneven": {"uneven_walk.toml"},
    "jaxik completion ": set(SHELLS),
}


def test_bash_completes_commands_options_choices_and_files(tmp_path, capsys):
    assert main.main(["completion", "bash"]) == 0
    (tmp_path / "jaxik.bash").write_text(capsys.readouterr().out)
    words = [line.replace(" ", "|") + "|\n" for line in COMPLETED]  # an empty last word counts
    done = subprocess.run(
        ["bash", "-c", SCRIPT, "bash", str(examples.REPOSITORY / "experiments")],
        env={"PATH": "/usr/bin:/bin"}, cwd=tmp_path, input="".join(words),
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    offered = [set(line.split()) for line in done.stdout.splitlines()]
    assert dict(zip(COMPLETED, offered, strict=True)) == COMPLETED


def test_there_is_a_script_for_each_shell(capsys):
    assert set(SHELLS) == set(shtab.SUPPORTED_SHELLS)
    for shell in SHELLS:
        assert main.main(["completion", shell]) == 0
        assert "calibrate" in capsys.readouterr().out, shell


def test_without_shtab_completion_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main.main(["completion", "bash"]) == main.MISTAKE
    assert capsys.readouterr().err == (
        'jaxik completion: needs shtab: pip install "jaxik[completion]"\n'
    )


def test_every_command_has_a_function():
    names = {name.partition(" ")[0] for name in commands()}
    assert names == {*COMMANDS, *without_jax.COMMANDS}
