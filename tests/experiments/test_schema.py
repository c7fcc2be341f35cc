"""Experiment files: what their reader and their JSON Schema accept, and the mistakes they name."""

import functools
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

import jsonschema

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
from support.experiments import CLIP

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
NUMBERS = [-1, -0.1, 0, 1e-12, 1e-9, 1e-3, 0.01, 0.5, 0.999, 1, 1.5, 2, 3, 1000, 1000.5, 1e6, 1e12]
NUMBERS += [2**32 - 1, 2**32, 1e39, -1e39, math.inf, -math.inf]
OTHERS = [True, False, "", "y", "huber", "adult", "x" * 1000, "x" * 1001, "a\nb", [], ["a"], [1]]
OTHERS += [[{}], {}, {"a": 1}]

Parts = dict[str, str]  # of the text of an experiment
VALID: list[Parts] = [
    {"free": '"foot.max_pitch" = {}\n"pelvis.on_gain" = { high = 0.9 }'},
    {"rest": "[parameters]\nfoot.max_pitch = [0.5, 0.6]", "free": '"foot.max_pitch[0]" = {}'},
    {"rest": "[sigmas]\nankle = inf\n[parameters]\nlock.max_speed = inf"},
    {"rest": "[sigmas.correlation]\nankle = 0.5"},
    {"rest": '[rules]\npelvis = "SupportPelvis"', "free": "pelvis.lowest_share = {}"},
    {"top": 'preset = "stride"', "free": "pelvis.softness = {}"},
    {"top": "faithful = true", "free": "contact.planted_height = {}"},
    {"rest": "[parameters]\nprobe.limited = false"},
    {"rest": "[parameters]\nprobe.layers = 3"},
    {"rest": "[prior]\nspread = 1\n[prior.pelvis]\non_gain.spread = 2"},
    {"rest": '[[without]]\nname = "a"\nrules.lock = "NoLock"'},
]
# In one part of the text each, with what the reader says; the schema refuses them as well.
MISTAKES = {
    "top": [
        ("fobs = 3", "unknown key 'fobs'; nearest is 'fps' of"),
        ("fps = 'x'", "fps is 'x'; wanted a number of Hz from 1 to 1000"),
        ("seed = 1.5", "seed is 1.5; wanted a whole number from 0"),
        ("name = 3", "name is 3; wanted a text"),
        ("loss = 'l2'", "loss is 'l2'; wanted one of .'squares', 'huber', 'cauchy'."),
        ("preset = 'recrod'", r"no preset named 'recrod'; there are \['mec', 'ozz', 'rec"),
        ("sigmas = 3", "sigmas is 3; wanted a table"),
    ],
    "clips": [
        ("", "there is no .clips."),
        ("clips = 3\n", r"clips is 3; wanted \[\[clips\]\]"),
        ("[clips]\nterrain = 'x'\n", r"clips is .*; wanted \[\[clips\]\]"),
        ("clips = [1]\n", r"\[\[clips\]\] is 1; wanted a table"),
        ("[[clips]]\nterrain = 'x'\n", "there is no reference"),
        (f"{CLIP}[[clips]]\nreference = 'a'\n", "there is no terrain; it needs reference and"),
        (f"{CLIP}bse = 'x'", r"\[\[clips\]\]: unknown key 'bse'; nearest is 'base' of"),
        (f"{CLIP}file_up = 'x'", "file_up is 'x'; wanted one of .'y', 'z'."),
        (f"{CLIP}root = 'floor'", "root is 'floor'; wanted one of .'auto', 'animation', 'ground'."),
        (f"{CLIP}start = 'x'", "start is 'x'; wanted a number of seconds"),
    ],
    "free": [
        ("", "there is no .free."),
        ("pelvis.on_gain = 3", "pelvis.on_gain is 3; wanted a table"),
        ("pelvis.on_gain = { lo = 1 }", "unknown key 'lo'; nearest is 'low'"),
        ("pelvis.on_gain = { low = 'x' }", "low is 'x'; wanted a finite number"),
        ("pelvis.on_gain = { prior_sd = 1 }", r"prior_sd is no key .*.prior.*{ spread = 1 }"),
        ("pelvis.on_gain = { kind = 'rough' }", "kind is 'rough'; wanted one of"),
        ("pelvis.on_gian = {}", r"\[free\]: no parameter named 'pelvis.on_gian'; nearest is"),
        ("lock.enabled = {}", "no parameter named 'lock.enabled'"),
        ("probe.limited = {}", "no parameter named 'probe.limited'"),
        ("pelvis.softness = {}", "no parameter named 'pelvis.softness'"),  # of another rule
        ('"pelvis.softness" = {}', "no parameter named 'pelvis.softness'"),
    ],
    "rest": [
        ("[fits]\nstarts = 1", "unknown key 'fits'; nearest is 'fit'"),
        ("[prior]\nshpae = 'normal'", r"\[prior\]: unknown key 'shpae'; nearest is 'shape'"),
        ("[prior]\nshape = 'flat'", "shape is 'flat'; wanted one of .'normal', 'uniform'."),
        ("[prior]\nspread = 0", "spread is 0; wanted a number from 0.001 to 1000"),
        ("[prior.pelvis]\non_gian = {}", "'pelvis.on_gian'; nearest is 'pelvis.on_gain'"),
        ("[prior.pelvis]\non_gain = 3", r"\[prior\] pelvis.on_gain is 3; wanted a table"),
        ("[prior.pelvis]\non_gain = { center = 1 }", "unknown key 'center'; nearest is 'centre'"),
        ("[prior.lock]\nenabled = {}", r"\[prior\]: unknown key 'lock.enabled'"),
        ("[start]\nfoot.max_ptich = 1", r"\[start\].*nearest is 'foot.max_pitch'"),
        ("[parameters]\nlock.speed = 1.0", r"\[parameters\]: unknown key 'lock.speed'"),
        ("[parameters]\npelvis.softness = 1", r"\[parameters\]: unknown key 'pelvis.softness'"),
        ("[parameters]\nlock.enabled = 1", "lock.enabled is 1; wanted true or false"),
        ("[parameters]\nprobe.layers = -1", "probe.layers is -1; wanted a whole number from 0"),
        ("[rules]\narm = 'TwoBone'", r"\[rules\]: unknown key 'arm'"),
        ("[rules]\nleg = 'FlatFoot'", "leg has no rule 'FlatFoot'; it has .'TwoBone'"),
        ("[sigmas]\nankel = 1", "unknown key 'ankel'; nearest is 'ankle'"),
        ("[sigmas]\nankle = true", "ankle is True; wanted a number from 1e-09"),
        ("[sigmas.correlation]\nankel = 0.1", "unknown key 'correlation.ankel'; nearest"),
        ("[noise]\nsigmas = true", r"sigmas is True; wanted one of \['given', 'estimated'\]"),
        ("[noise]\ncorrelation = 'estimated'", "wanted one of .*whitened"),
        ("[noise]\nsigma = 'given'", "unknown key 'sigma'; nearest is 'sigmas'"),
        ("[fit]\nmaxsteps = 1", "unknown key 'maxsteps'; nearest is 'max_steps'"),
        ("[fit.search]\nelit = 3", r"\[fit.search\]: unknown key 'elit'; nearest is 'elite'"),
        ("[fit.search]\nmax_steps = 3", r"\[fit.search\]: unknown key 'max_steps'"),
        ("[fit.search]\nelite = 1.5", "elite is 1.5; wanted a whole number from 1"),
        ("[sample]\nstop_at = 'x'", "stop_at is 'x'; wanted a number from 0"),
        ("[hierarchy]\nper_clip = 'pelvis.on_gain'", "per_clip is 'pelvis.on_gain'; wanted a list"),
        ("[[without]]\nparameters = { lock.enabled = false }", "a variant without a name; wanted"),
        ("[[without]]\nname = 'a'\nfixed = {}", "unknown key 'fixed'; nearest is 'free' of"),
    ],
}
PAIRS: list[tuple[Parts, str]] = [
    (
        {"top": "preset = 'stride'\nfaithful = true", "free": "probe.steepness = {}"},
        "'stride' has no other original; faithful is for",
    ),
    ({"top": "faithful = true", "free": "contact.raised_speed = {}"}, "no parameter named 'contac"),
    (
        {"rest": '[rules]\npelvis = "SupportPelvis"', "free": "pelvis.on_gain = {}"},
        "no parameter named 'pelvis.on_gain'",
    ),
]
BEYOND_SCHEMA: list[tuple[Parts, str]] = [  # about files, or about more than one value
    ({"clips": "[[clips]]\nterrain = 'x'\nreference = 'y'\n"}, "reference 'y': no such file"),
    ({"clips": "[[clips]]\nterrain = 'x'\nreference = '.'\n"}, "reference '.': a folder"),
    ({"clip": "truth = 'no.toml'"}, "truth 'no.toml': no such file"),
    ({"clips": f"{CLIP}start = 3.0\nend = 1.0"}, "end is 1.0; wanted more than start"),
    ({"free": "pelvis.on_gain = { low = nan }"}, "low is nan; wanted a finite number"),
    ({"free": "pelvis = {}"}, "no parameter named 'pelvis'; nearest is 'pelvis"),
    ({"free": 'foot."max_pitch[7]" = {}'}, r"no element 'foot.max_pitch\[7\]'"),
    ({"free": "contact.raised_height = { high = 0.05 }"}, r"\[free\]: contact.raised_height stays"),
    ({"rest": "[prior]\nshape = 'uniform'\nspread = 1"}, "prior.: spread is given, but a uniform"),
    (
        {"rest": "[prior.pelvis]\non_gain = { shape = 'uniform', centre = 0.1 }"},
        "prior. pelvis.on_gain: centre is given, but a uniform prior has none",
    ),
    ({"rest": "[prior.pelvis]\non_gain.centre = 2"}, r"\[prior\]: pelvis.on_gain: centre is 2"),
    ({"rest": "[start]\npelvis.on_gain = 2"}, r"\[start\]: pelvis.on_gain: start is 2, wanted f"),
    ({"rest": "[sigmas]\nankle = nan"}, "ankle is nan; wanted a number from 1e-09 to 1e.09, or i"),
    (
        {"top": "independent_every = 1.0", "rest": "[noise]\ncorrelation = 'whitened'"},
        "would account for the same correlation twice",
    ),
    (
        {"top": "loss = 'cauchy'", "rest": "[noise]\nsigmas = 'estimated'"},
        "cannot be estimated under the loss 'cauchy'.*student",
    ),
    ({"rest": "[fit.search]\npopulation = 8"}, r"\[fit.search\]: gauss_newton_children is 16"),
    ({"rest": "[sample]\nwalkers = 5"}, "walkers is 5, wanted an even number from 4"),
    (
        {"rest": "[sigmas]\nankle = inf\nknee = inf\npelvis = inf\nfoot = inf"},
        "wanted one that is not",
    ),
    (
        {"rest": "[sample]\nwalkers = 10_000\nmax_steps = 1_000_000"},
        "149 GiB, wanted at most 8; take a",
    ),
    ({"rest": "[sample]\nmax_steps = 10\nthin_by = 20"}, "wanted at least thin_by"),
    ({"rest": "[hierarchy]\nper_clip = [[]]"}, "per_clip is .*; wanted a list of names"),
    ({"rest": "[hierarchy]\nper_subject = [1, {}]"}, "per_subject is .*; wanted a list of names"),
    ({"rest": '[hierarchy]\nper_clip = ["a\\u0000"]'}, "per_clip is .*; wanted a list of names"),
    ({"rest": "[prior.pelvis]\non_gain = { centre = inf }"}, "centre is inf; wanted a finite numb"),
    ({"rest": "[start]\npelvis.on_gain = inf"}, "on_gain is inf; wanted a finite number"),
]
BOUNDS = [  # of a free parameter, neither too narrow nor too wide
    ("low = 0.3, high = 0.3", "low < high"),
    ("low = 0.5, high = 0.1", "bounds are 0.5 to 0.1.*low < high"),
    ("low = inf", "low is inf; wanted a finite number"),
    ("high = 1e300", "high is 1e.300; wanted a finite number"),
    ("high = 1e30", "1e.30 apart, wanted .*; its rule has 0"),
    ("low = 0.5, high = 0.50000000001", "apart, wanted"),
    ("low = 0.0, high = 1e-300", "1e-300 apart, wanted 1.4e-06 to"),
    ("low = 1e-13, high = 1.0, scale = 'log'", "at most 1e.12 times the lower one"),
    ("low = 1e-300, high = 0.5, scale = 'gain'", "strictly between 1e-09 and 0.999999999"),
    ("low = 0.5, high = 1.0, scale = 'gain'", "strictly between 1e-09 and 0.999999999"),
]
BEYOND_SCHEMA += [
    ({"free": f"foot.max_pitch = {{ {bounds} }}"}, f".free..*max_pitch.*{said}")
    for bounds, said in BOUNDS
]


@functools.cache
def schema() -> Content:
    return experiment_schema()


@functools.cache
def validator() -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(schema())


def read(folder, parts: Parts) -> str:
    """What the reader says of an experiment with these parts; nothing of a valid one."""
    try:
        loaded = experiment_files.load_experiment(experiments.write(folder, **parts))
        loaded.space(loaded.starting_system())
    except ValueError as error:
        return str(error)
    return ""


def is_valid(parts: Parts) -> bool:
    return validator().is_valid(tomllib.loads(experiments.text(**parts)))


def test_the_reader_says_what_is_wrong_and_what_was_wanted(tmp_path):
    mistakes = [({part: text}, said) for part, rows in MISTAKES.items() for text, said in rows]
    offenders = [
        (parts, answer)
        for parts, message in mistakes + PAIRS + BEYOND_SCHEMA
        if not re.search(f"experiment.toml.*{message}", answer := read(tmp_path, parts))
    ]
    assert offenders == []
    accepted = [parts for parts, _ in mistakes + PAIRS if is_valid(parts)]
    assert accepted == [], "by the schema"


def test_what_the_reader_takes_is_valid(tmp_path):
    assert [parts for parts in VALID if read(tmp_path, parts) or not is_valid(parts)] == []


def objects(schema: object, path: str = "") -> Iterator[tuple[str, Content]]:
    """Every schema of a table inside a schema, with its place."""
    if isinstance(schema, Mapping):
        if schema.get("type") == "object":
            yield path, dict(schema)
        for key, part in schema.items():
            yield from objects(part, f"{path}/{key}")


def test_it_is_a_schema_that_json_can_hold():
    jsonschema.Draft202012Validator.check_schema(schema())
    assert json.loads(json.dumps(schema(), allow_nan=False)) == schema()


def test_every_shipped_experiment_is_valid():
    shipped = sorted((experiments.ROOT / "data" / "experiments").rglob("*.toml"))
    assert len(shipped) > 5
    for path in shipped:
        validator().validate(tomllib.loads(path.read_text(encoding="utf-8")))


def test_the_schema_of_a_key_accepts_what_the_reader_accepts():
    offenders = []
    for table, key in ((table, key) for table, known in KEYS.items() for key in known):
        constraint = KEYS[table][key]
        (schema,) = named({key: constraint})["properties"].values()
        validator = jsonschema.Draft202012Validator(schema)
        for value in NUMBERS + OTHERS:
            if isinstance(value, float) and value.is_integer():
                continue  # JSON Schema counts 2.0 as a whole number
            if isinstance(value, list) and constraint.schema.get("items") is None:
                continue  # elements of which the reader makes sure elsewhere
            if validator.is_valid(value) != constraint.accepts(value):
                offenders.append((table, key, value))
    assert offenders == []


def test_every_key_of_every_table_has_a_meaning():
    tables = [table for path, table in objects(schema()) if "properties" in table]
    assert len(tables) > 50
    for table in tables:
        for name, part in table["properties"].items():
            if name not in systems.STAGES:
                assert re.search(r"[.)]$", part["description"]), name
        assert table["additionalProperties"] is False


def test_all_parameters_of_a_preset_are_valid_as_parameter_files_write_them():
    for preset in systems.all_presets():
        ik = preset.system()
        values = tomllib.loads(parameter_files.system_to_toml(ik, preset))
        tables = {stage: values[stage] for stage in systems.STAGES if stage in values}
        free: dict[str, Content] = {}
        for name in parameter_tree.declarations(ik):
            free.setdefault(name.partition(".")[0], {})[name.partition(".")[2]] = {}
        clips = [{"reference": "a", "terrain": "b"}]
        content: Any = preset.keys() | {"clips": clips, "free": free, "parameters": tables}
        assert validator().is_valid(content), preset


def test_meaning_unit_range_and_defaults_of_a_parameter_are_in_its_description():
    limit = schema()["properties"]["parameters"]["properties"]["pelvis"]["properties"]["limit"]
    declared = parameter_tree.declarations(systems.preset_system("record"))["pelvis.limit"]
    assert declared.doc in limit["description"] and "Unit: m." in limit["description"]
    assert f"Range: {declared.low:g} to {declared.high:g}." in limit["description"]
    assert "inf m in ozz" in limit["description"]


def test_defaults_are_those_that_the_reader_fills_in():
    tables = schema()["properties"]
    assert tables["preset"]["default"] == "record" and tables["loss"]["default"] == "squares"
    assert tables["clips"]["items"]["properties"]["file_up"]["default"] == "y"
    assert tables["fit"]["properties"]["max_steps"]["default"] == 1000
    assert tables["fit"]["properties"]["search"]["properties"]["population"]["default"] == 64
    assert tables["sigmas"]["properties"]["ankle"]["default"] == 0.02
    assert "Default: inf." in tables["sigmas"]["properties"]["body"]["description"]


def test_the_page_on_experiment_files_names_every_key():
    page = (experiments.ROOT / "fitting" / "README.md").read_text(encoding="utf-8")
    section = page.partition("\n## Experiment files\n")[2].partition("\n## Parameter files\n")[0]
    for table in KEYS.keys() - {"search", "sample"}:  # which `jaxik schema` lists
        for key in KEYS[table]:
            word = key.rpartition(".")[2]
            assert re.search(rf"(?<!\w){word}\b", section), f"{table}: {key}"
