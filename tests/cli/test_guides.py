"""The commands that explain: `parameters`, `schema`, `example`, `completion`."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest

from fitting.cli import main, without_jax
from fitting.cli.parser import make_parser
from fitting.cli.parsers.guides import SHELLS
from fitting.experiments import systems
from fitting.experiments.experiment_files import load_experiment
from fitting.experiments.schema.experiment_schema import experiment_schema
from fitting.jobs import examples
from jaxik.maths import parameter_tree

shtab = pytest.importorskip("shtab")


@pytest.mark.parametrize("columns", [60, 80, 200])
@pytest.mark.parametrize("command", ["parameters", "schema"])
def test_lists_fit_into_the_terminal(command, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main.main([command]) == 0
    lines = capsys.readouterr().out.splitlines()
    too_long = [line for line in lines if len(line) > max(columns, 75)]  # the cells without prose
    assert len(lines) > 80 and not too_long


@pytest.mark.parametrize("preset", systems.preset_names())
def test_parameters_lists_every_one_with_its_declaration(preset, capsys):
    assert main.main(["parameters", preset, "--format", "json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    ik = systems.preset_system(preset)
    assert list(rows) == [*parameter_tree.docs(ik)]
    for name, declared in parameter_tree.declarations(ik).items():
        row = rows[name]
        assert (row["low"], row["high"], row["unit"]) == (
            declared.low,
            declared.high,
            declared.unit,
        )
        assert row["meaning"] == declared.doc and row["kind"] == declared.kind


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
    assert main.main(words) == main.MISTAKE
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


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


@pytest.mark.parametrize("name", ["uneven_walk", "calibration/ozz_noise", "mec"])
def test_a_copied_example_is_whole_and_names_its_schema(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main.main(["example", name, "-o", "copy"]) == 0
    path = tmp_path / "copy" / f"{Path(name).name}.toml"
    loaded, original = load_experiment(path), load_experiment(examples.path_of(name))
    assert (loaded.free, loaded.prior, loaded.sigmas) == (
        original.free, original.prior, original.sigmas,
    )  # fmt: skip
    for clip, source in zip(loaded.clips, original.clips, strict=True):
        assert clip.reference.is_relative_to(tmp_path)
        assert clip.reference.read_bytes() == source.reference.read_bytes()
        assert clip.terrain.read_bytes() == source.terrain.read_bytes()
    text = path.read_text(encoding="utf-8")
    schema = path.parent / text.splitlines()[0].removeprefix("#:schema ")
    jsonschema.validate(tomllib.loads(text), json.loads(schema.read_text(encoding="utf-8")))
    assert main.main(["example", name, "-o", "copy"]) == main.MISTAKE
    assert "is already there" in capsys.readouterr().err


def completed(*words: str) -> list[str]:
    """What bash offers for the last of these words."""
    script = """
    source <("$PYTHON" -m fitting.cli.main completion bash) || exit 1
    COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
    $(complete -p jaxik | sed 's/.*-F \\([^ ]*\\).*/\\1/')
    printf '%s\\n' "${COMPREPLY[@]}"
    """
    done = subprocess.run(
        ["bash", "-c", script, "bash", *words],
        env={"PYTHON": sys.executable, "PATH": "/usr/bin:/bin"},
        check=True,
        capture_output=True,
        text=True,
        cwd=examples.REPOSITORY / "experiments",
    )
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["jaxik", "para"], {"parameters"}),
        (["jaxik", "parameters", "--format", ""], {"text", "markdown", "json"}),
        (["jaxik", "record", "to-"], {"to-toml", "to-bytes"}),
        (["jaxik", "fit", "uneven"], {"uneven_walk.toml"}),
        (["jaxik", "completion", ""], set(SHELLS)),
    ],
)
def test_bash_completes_commands_options_choices_and_files(words, wanted):
    assert wanted == set(completed(*words))


@pytest.mark.parametrize("shell", SHELLS)
def test_there_is_a_script_for_each_shell(shell, capsys):
    assert main.main(["completion", shell]) == 0
    assert "calibrate" in capsys.readouterr().out
    assert set(SHELLS) == set(shtab.SUPPORTED_SHELLS)


def test_without_shtab_completion_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main.main(["completion", "bash"]) == main.MISTAKE
    assert capsys.readouterr().err == (
        'jaxik completion: needs shtab: pip install "jaxik[completion]"\n'
    )


def test_every_command_has_a_function():
    from fitting.cli.commands import COMMANDS

    (words,) = (action.choices for action in make_parser()._actions if action.dest == "command")
    assert set(words or ()) == {*COMMANDS, *without_jax.COMMANDS}
