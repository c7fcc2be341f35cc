"""The JSON Schema of experiment files against their reader, as `jsonschema` understands it."""

import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path

import jsonschema
import pytest

from fitting.experiments import (
    ablations,
    experiment_files,
    hierarchies,
    parameter_files,
    systems,
)
from fitting.experiments.schema import keys
from fitting.experiments.schema.experiment_schema import experiment_schema
from fitting.experiments.schema.tables import named
from fitting.experiments.tables import prior_tables
from fitting.runtime.validation import Constraint, Content
from jaxik.maths import parameter_tree
from support import experiments

SCHEMA = experiment_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
SHIPPED = sorted((experiments.ROOT / "data" / "experiments").rglob("*.toml"))
KEYS: dict[str, Mapping[str, Constraint]] = {
    "top": experiment_files.TOP_KEYS,
    "clips": keys.CLIP_KEYS,
    "sigmas": experiment_files.SIGMA_KEYS,
    "fit": experiment_files.FIT_KEYS,
    "search": experiment_files.SEARCH_KEYS,
    "sample": experiment_files.SAMPLE_KEYS,
    "noise": experiment_files.NOISE_KEYS,
    "free": systems.FREE_KEYS,
    "prior": prior_tables.KEYS,
    "hierarchy": hierarchies.KEYS,
    "without": ablations.KEYS,
}
CONSTRAINTS = [(table, key) for table, keys in KEYS.items() for key in keys]
NUMBERS = [-1, -0.1, 0, 1e-12, 1e-9, 1e-3, 0.01, 0.5, 0.999, 1, 1.5, 2, 3, 1000, 1000.5, 1e6, 1e12]
NUMBERS += [2**32 - 1, 2**32, 1e39, -1e39, math.inf, -math.inf]
OTHERS = [True, False, "", "y", "huber", "adult", "x" * 1000, "x" * 1001, "a\nb", [], ["a"], [1]]
OTHERS += [[{}], {}, {"a": 1}]


def refused_by_schema(text: str) -> bool:
    return not VALIDATOR.is_valid(tomllib.loads(text))


def refused_by_reader(text: str, folder: Path) -> bool:
    path = folder / "experiment.toml"
    path.write_text(text, encoding="utf-8")
    try:
        loaded = experiment_files.load_experiment(path)
        loaded.space(loaded.starting_system())
    except ValueError:
        return True
    return False


def objects(schema: object, path: str = "") -> Iterator[tuple[str, Content]]:
    """Every schema of a table inside a schema, with its place."""
    if isinstance(schema, Mapping):
        if schema.get("type") == "object":
            yield path, dict(schema)
        for key, part in schema.items():
            yield from objects(part, f"{path}/{key}")


def test_it_is_a_schema_that_json_can_hold():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert json.loads(json.dumps(SCHEMA, allow_nan=False)) == SCHEMA


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_experiment_is_valid(path):
    VALIDATOR.validate(tomllib.loads(path.read_text(encoding="utf-8")))


@pytest.mark.parametrize(("table", "key"), CONSTRAINTS)
def test_the_schema_of_a_key_accepts_what_the_reader_accepts(table, key):
    constraint = KEYS[table][key]
    (schema,) = named({key: constraint})["properties"].values()
    validator = jsonschema.Draft202012Validator(schema)
    for value in NUMBERS + OTHERS:
        if isinstance(value, float) and value.is_integer():
            continue  # JSON Schema counts 2.0 as a whole number
        if isinstance(value, list) and constraint.schema.get("items") is None:
            continue  # elements of which the reader makes sure elsewhere
        assert validator.is_valid(value) == constraint.accepts(value), value


def test_every_key_of_every_table_has_a_meaning():
    tables = [table for path, table in objects(SCHEMA) if "properties" in table]
    assert len(tables) > 50
    for table in tables:
        for name, schema in table["properties"].items():
            if name not in systems.STAGES:
                assert re.search(r"[.)]$", schema["description"]), name
        assert table["additionalProperties"] is False


@pytest.mark.parametrize(
    "preset", systems.all_presets(), ids=lambda preset: " ".join(map(str, preset))
)
def test_all_parameters_of_a_preset_are_valid_as_parameter_files_write_them(preset):
    ik = preset.system()
    values = tomllib.loads(parameter_files.system_to_toml(ik, preset))
    tables = {stage: values[stage] for stage in systems.STAGES if stage in values}
    free: dict[str, Content] = {}
    for name in parameter_tree.declarations(ik):
        free.setdefault(name.partition(".")[0], {})[name.partition(".")[2]] = {}
    content = {"clips": [{"reference": "a", "terrain": "b"}], "free": free, "parameters": tables}
    VALIDATOR.validate(preset.keys() | content)


def test_meaning_unit_range_and_defaults_of_a_parameter_are_in_its_description():
    limit = SCHEMA["properties"]["parameters"]["properties"]["pelvis"]["properties"]["limit"]
    declared = parameter_tree.declarations(systems.preset_system("record"))["pelvis.limit"]
    assert declared.doc in limit["description"] and "Unit: m." in limit["description"]
    assert f"Range: {declared.low:g} to {declared.high:g}." in limit["description"]
    assert "inf m in ozz" in limit["description"]


def test_defaults_are_those_that_the_reader_fills_in():
    schema = SCHEMA["properties"]
    assert schema["preset"]["default"] == "record" and schema["loss"]["default"] == "squares"
    assert schema["clips"]["items"]["properties"]["file_up"]["default"] == "y"
    assert schema["fit"]["properties"]["max_steps"]["default"] == 1000
    assert schema["fit"]["properties"]["search"]["properties"]["population"]["default"] == 64
    assert schema["sigmas"]["properties"]["ankle"]["default"] == 0.02
    assert "Default: inf." in schema["sigmas"]["properties"]["body"]["description"]


def test_the_page_on_experiment_files_names_every_key():
    page = (experiments.ROOT / "fitting" / "README.md").read_text(encoding="utf-8")
    section = page.partition("\n## Experiment files\n")[2].partition("\n## Parameter files\n")[0]
    for table in KEYS.keys() - {"search", "sample"}:  # which `jaxik schema` lists
        for key in KEYS[table]:
            word = key.rpartition(".")[2]
            assert re.search(rf"(?<!\w){word}\b", section), f"{table}: {key}"


VALID = {
    "names in quotes": {"free": '"foot.max_pitch" = {}\n"pelvis.on_gain" = { high = 0.9 }'},
    "one leg": {
        "rest": "[parameters]\nfoot.max_pitch = [0.5, 0.6]",
        "free": '"foot.max_pitch[0]" = {}',
    },
    "no limit": {"rest": "[sigmas]\nankle = inf\n[parameters]\nlock.max_speed = inf"},
    "a correlation for each kind": {"rest": "[sigmas.correlation]\nankle = 0.5"},
    "another rule": {
        "rest": '[rules]\npelvis = "SupportPelvis"',
        "free": "pelvis.lowest_share = {}",
    },
    "another preset": {"top": 'preset = "stride"', "free": "pelvis.softness = {}"},
    "an original": {"top": "faithful = true", "free": "contact.planted_height = {}"},
    "an option": {"rest": "[parameters]\nprobe.limited = false"},
    "layers": {"rest": "[parameters]\nprobe.layers = 3"},
    "a prior of one parameter": {"rest": "[prior]\nspread = 1\n[prior.pelvis]\non_gain.spread = 2"},
    "a variant": {"rest": '[[without]]\nname = "a"\nrules.lock = "NoLock"'},
}
INVALID = {
    "unknown key": {"top": "speed = 1"},
    "wrong type": {"top": "fps = '30'"},
    "number out of range": {"top": "fps = 0.5"},
    "unknown word": {"top": "loss = 'cubes'"},
    "unknown preset": {"top": "preset = 'walker'"},
    "original that is none": {
        "top": "preset = 'stride'\nfaithful = true", "free": "probe.steepness = {}",
    },
    "fraction for a count": {"top": "seed = 0.5"},
    "unknown table": {"rest": "[fits]\nstarts = 1"},
    "no clips": {"clips": ""},
    "nothing free": {"free": ""},
    "unknown key of a clip": {"clip": "speed = 1"},
    "clip without terrain": {"clip": "[[clips]]\nreference = 'a'"},
    "free switch": {"free": "lock.enabled = {}"},
    "free option": {"free": "probe.limited = {}"},
    "free parameter that is no table": {"free": "pelvis.limit = 1"},
    "free parameter of another rule": {"free": "pelvis.softness = {}"},
    "the same in quotes": {"free": '"pelvis.softness" = {}'},
    "free parameter of the original's rule": {
        "top": "faithful = true", "free": "contact.raised_speed = {}",
    },
    "free parameter of the preset's rule": {
        "rest": '[rules]\npelvis = "SupportPelvis"', "free": "pelvis.on_gain = {}",
    },
    "kind of a free parameter": {"free": "pelvis.on_gain = { kind = 'a' }"},
    "key of a free parameter": {"free": "pelvis.on_gain = { lower = 0.1 }"},
    "fixed parameter of another rule": {"rest": "[parameters]\npelvis.softness = 1"},
    "text for a fixed parameter": {"rest": "[parameters]\npelvis.limit = 'x'"},
    "number for a switch": {"rest": "[parameters]\nlock.enabled = 1"},
    "negative layers": {"rest": "[parameters]\nprobe.layers = -1"},
    "unknown stage of a rule": {"rest": "[rules]\narm = 'TwoBone'"},
    "rule of another stage": {"rest": "[rules]\nleg = 'FlatFoot'"},
    "key of the search": {"rest": "[fit.search]\npopulations = 3"},
    "range of the search": {"rest": "[fit.search]\npopulation = 1"},
    "count of starts": {"rest": "[fit]\nstarts = 0"},
    "walkers": {"rest": "[sample]\nwalkers = 1.5"},
    "noise": {"rest": "[noise]\nsigmas = 'guessed'"},
    "key of the prior": {"rest": "[prior]\nwidth = 1"},
    "prior of a switch": {"rest": "[prior.lock]\nenabled = {}"},
    "spread of a prior": {"rest": "[prior.pelvis]\non_gain = { spread = 0.0 }"},
    "unknown start": {"rest": "[start]\nlock.speed = 1.0"},
    "correlation of an unknown kind": {"rest": "[sigmas.correlation]\nhand = 0.5"},
    "correlation of 1": {"rest": "[sigmas]\ncorrelation = 1.0"},
    "names that are no list": {"rest": "[hierarchy]\nper_clip = 'pelvis.on_gain'"},
    "variant without a name": {"rest": "[[without]]\nparameters = { lock.enabled = false }"},
    "key of a variant": {"rest": "[[without]]\nname = 'a'\nfixed = {}"},
}  # fmt: skip


@pytest.mark.parametrize("name", VALID)
def test_what_the_reader_takes_is_valid(name, tmp_path):
    text = experiments.text(**VALID[name])
    assert not refused_by_reader(text, tmp_path)
    VALIDATOR.validate(tomllib.loads(text))


@pytest.mark.parametrize("name", INVALID)
def test_what_the_reader_refuses_is_invalid(name, tmp_path):
    text = experiments.text(**INVALID[name])
    assert refused_by_reader(text, tmp_path) and refused_by_schema(text)
