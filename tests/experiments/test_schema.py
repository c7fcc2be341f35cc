"""Experiment files: what their reader and their JSON Schema accept, and the mistakes they name."""

import functools
import json
import math
import re
import time
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jsonschema
import pytest

import jaxik
from fitting.experiment import experiment, experiment_files, parameter_files, systems
from fitting.experiment.experiment import (
    ALL_SIGMA_KEYS,
    FIT_KEYS,
    SEARCH_KEYS,
    ClipEntry,
    Experiment,
)
from fitting.experiment.file_tables import Ablation, Hierarchy
from fitting.experiment.schema import experiment_schema
from fitting.inference.noise import NoiseOptions
from fitting.inference.optimise.solution import SearchSettings
from fitting.inference.sample.blocks import SamplerSettings
from fitting.problem.scene import LEAST_SIGMAS
from fitting.problem.space import Override, ParameterPrior
from fitting.runtime import validation
from fitting.runtime.declarations import Key, keys, table_schema
from fitting.runtime.validation import Content
from jaxik.maths import parameter_tree
from support.experiments import CLIP, ROOT, text, write

KEYS: dict[str, Mapping[str, Key]] = {
    "top": keys(Experiment),
    "clips": keys(ClipEntry),
    "sigmas": ALL_SIGMA_KEYS,
    "fit": FIT_KEYS,
    "search": SEARCH_KEYS,
    "sample": keys(SamplerSettings),
    "noise": keys(NoiseOptions),
    "free": keys(Override),
    "prior": keys(ParameterPrior),
    "hierarchy": keys(Hierarchy),
    "without": keys(Ablation),
}
NUMBERS = [-1, -0.1, 0, 1e-12, 1e-9, 1e-3, 0.01, 0.5, 0.999, 1, 1.5, 2, 3, 1000, 1000.5, 1e6, 1e12]
NUMBERS += [2**32 - 1, 2**32, 1e39, -1e39, math.inf, -math.inf]
OTHERS = [True, False, "", "y", "huber", "adult", "x" * 1000, "x" * 1001, "a\nb", [], ["a"], [1]]
OTHERS += [[{}], {}, {"a": 1}]

Parts = dict[str, str]  # of the text of an experiment
VALID: list[Parts] = [
    {"free": '"foot.max_pitch" = {}\n"pelvis.half_life" = { high = 0.9 }'},
    {"rest": "[parameters]\nfoot.max_pitch = [0.5, 0.6]", "free": '"foot.max_pitch[0]" = {}'},
    {"rest": "[sigmas]\nankle = inf\n[parameters]\nlock.max_speed = inf"},
    {"rest": "[sigmas.correlation]\nankle = 0.5"},
    {"rest": '[rules]\npelvis = "SupportPelvis"', "free": "pelvis.lowest_share = {}"},
    {"top": 'preset = "stride"', "free": "pelvis.softness = {}"},
    {"top": "faithful = true", "free": "contact.planted_height = {}"},
    {"rest": "[parameters]\nprobe.limited = false"},
    {"rest": "[parameters]\nprobe.layers = 3"},
    {"rest": "[prior]\nspread = 1\n[prior.pelvis]\nhalf_life.spread = 2"},
    {"rest": '[[without]]\nname = "a"\nrules.lock = "NoLock"'},
    {"rest": '[capture]\nscale = {}\n"time_shift[0]" = { low = -0.1 }\nankle_up.high = 0.05'},
    {
        "rest": "[capture]\nscale = {}\n[prior.capture]\nscale.centre = 1.01\n"
        "[start]\ncapture.scale = 1"
    },
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
        ("", "there is no ..clips.."),
        ("clips = 3\n", r"clips is 3; wanted \[\[clips\]\]"),
        ("clips = [1]\n", r"\[\[clips\]\] is 1; wanted a table"),
        ("[[clips]]\nterrain = 'x'\n", "reference is missing"),
        (f"{CLIP}[[clips]]\nreference = 'a'\n", "terrain is missing; it needs reference and"),
        (f"{CLIP}bse = 'x'", r"\[\[clips\]\]: unknown key 'bse'; nearest is 'base' of"),
        (f"{CLIP}file_up = 'x'", "file_up is 'x'; wanted one of .'y', 'z'."),
        (f"{CLIP}start = 'x'", "start is 'x'; wanted a number of seconds"),
    ],
    "free": [
        ("pelvis.half_life = 3", "pelvis.half_life is 3; wanted a table"),
        ("pelvis.half_life = { lo = 1 }", "unknown key 'lo'; nearest is 'low'"),
        ("pelvis.half_life = { low = 'x' }", "low is 'x'; wanted a finite number"),
        ("pelvis.half_life = { prior_sd = 1 }", r"prior_sd is not a key .*.prior.*{ spread = 1 }"),
        ("pelvis.half_life = { kind = 'rough' }", "kind is 'rough'; wanted one of"),
        ("pelvis.on_gian = {}", r"\[free\]: no parameter named 'pelvis.on_gian'; nearest is"),
        ("lock.enabled = {}", "no parameter named 'lock.enabled'"),
        ("probe.limited = {}", "no parameter named 'probe.limited'"),
        ("pelvis.softness = {}", "no parameter named 'pelvis.softness'"),  # of another rule
    ],
    "rest": [
        ("[fits]\nstarts = 1", "unknown key 'fits'; nearest is 'fit'"),
        ("[prior]\nshpae = 'normal'", r"\[prior\]: unknown key 'shpae'; nearest is 'shape'"),
        ("[prior]\nshape = 'flat'", "shape is 'flat'; wanted one of .'normal', 'uniform'."),
        ("[prior.pelvis]\non_gian = {}", "'pelvis.on_gian'; nearest is 'pelvis.half_life'"),
        ("[prior.pelvis]\nhalf_life = 3", r"\[prior\] pelvis.half_life is 3; wanted a table"),
        ("[prior.pelvis]\nhalf_life = { center = 1 }", "unknown key 'center'; nearest is 'centre'"),
        ("[prior.lock]\nenabled = {}", r"\[prior\]: unknown key 'lock.enabled'"),
        ("[start]\nfoot.max_ptich = 1", r"\[start\].*nearest is 'foot.max_pitch'"),
        ("[parameters]\nlock.speed = 1.0", r"\[parameters\]: unknown key 'lock.speed'"),
        ("[parameters]\npelvis.softness = 1", r"\[parameters\]: unknown key 'pelvis.softness'"),
        ("[parameters]\nlock.enabled = 1", "lock.enabled is 1; wanted true or false"),
        ("[rules]\narm = 'TwoBone'", r"\[rules\]: unknown key 'arm'"),
        ("[rules]\nleg = 'FlatFoot'", "leg has no rule 'FlatFoot'; it has .'TwoBone'"),
        ("[capture]\nheight = {}", "unknown key 'height'; nearest is 'ground_height'"),
        ("[capture]\nscale = { lo = 1 }", r"\[capture\] scale: unknown key 'lo'; nearest is"),
        ("[capture]\nscale = 1.01", r"\[capture\] scale is 1.01; wanted a table"),
        ("[capture]\n'scale[x]' = {}", r"no clip for 'scale\[x\]'; wanted a number of"),
        ("[sigmas]\nankel = 1", "unknown key 'ankel'; nearest is 'ankle'"),
        ("[sigmas]\nankle = true", "ankle is True; wanted a number from 0.001"),
        ("[sigmas.correlation]\nankel = 0.1", "unknown key 'correlation.ankel'; nearest"),
        ("[noise]\nsigmas = true", r"sigmas is True; wanted one of \['given', 'estimated'\]"),
        ("[noise]\ncorrelation = 'estimated'", "wanted one of .*whitened"),
        ("[noise]\nsigma = 'given'", "unknown key 'sigma'; nearest is 'sigmas'"),
        ("[fit]\nmaxsteps = 1", "unknown key 'maxsteps'; nearest is 'max_steps'"),
        ("[fit.search]\nelit = 3", r"\[fit.search\]: unknown key 'elit'; nearest is 'elite'"),
        ("[fit.search]\nmax_steps = 3", r"\[fit.search\]: unknown key 'max_steps'"),
        ("[[without]]\nparameters = { lock.enabled = false }", "name is missing; it needs name"),
        ("[[without]]\nname = 3", "name is 3; wanted a text"),
        ("[[without]]\nname = 'a'\nfixed = {}", "unknown key 'fixed'; nearest is 'free' of"),
    ],
}
ORIGINAL, OTHER = "faithful = true", '[rules]\npelvis = "SupportPelvis"'
PAIRS: list[tuple[Parts, str]] = [
    ({"top": f"preset = 'stride'\n{ORIGINAL}", "free": "probe.steepness = {}"}, "other original"),
    ({"top": ORIGINAL, "free": "contact.raised_speed = {}"}, "no parameter named 'contact.raised"),
    ({"rest": OTHER, "free": "pelvis.half_life = {}"}, "no parameter named 'pelvis.half_life'"),
]
UNIFORM = "{ shape = 'uniform', centre = 0.1 }"
WHITENED, ESTIMATED = "[noise]\ncorrelation = 'whitened'", "[noise]\nsigmas = 'estimated'"
BEYOND_SCHEMA: list[tuple[Parts, str]] = [  # about files, or about more than one value
    ({"clips": "[[clips]]\nterrain = 'x'\nreference = 'y'\n"}, "reference 'y': no such file"),
    ({"clips": "[[clips]]\nterrain = 'x'\nreference = '.'\n"}, "reference '.': a folder"),
    ({"clip": "truth = 'no.toml'"}, "truth 'no.toml': no such file"),
    ({"clip": "truth = '.'"}, "truth '.': a folder"),
    ({"clips": f"{CLIP}start = 3.0\nend = 1.0"}, "end is 1.0; wanted more than start"),
    ({"free": "pelvis.half_life = { low = nan }"}, "low is nan; wanted a finite number"),
    ({"free": "pelvis = {}"}, "no parameter named 'pelvis'; nearest is 'pelvis"),
    ({"free": 'foot."max_pitch[7]" = {}'}, r"no element 'foot.max_pitch\[7\]'"),
    ({"free": "contact.raised_height = { high = 0.05 }"}, r"\[free\]: contact.raised_height stays"),
    ({"rest": "[prior]\nshape = 'uniform'\nspread = 1"}, "prior.: spread is given, but a uniform"),
    (
        {"rest": f"[prior.pelvis]\nhalf_life = {UNIFORM}"},
        "half_life: centre is given, but a uniform p",
    ),
    ({"rest": "[sigmas]\nankle = nan"}, "ankle is nan; wanted a number from 0.001 to 1e.09, or i"),
    ({"top": "independent_every = 1.0", "rest": WHITENED}, "for the same correlation twice"),
    ({"top": "loss = 'huber'", "rest": ESTIMATED}, "under the loss 'huber'.*student"),
    ({"top": "loss = 'cauchy'", "rest": ESTIMATED}, "the loss 'cauchy'.*student"),
    ({"rest": "[fit.search]\npopulation = 8"}, r"\[fit.search\]: gauss_newton_children is 16"),
    ({"rest": "[sample]\nwalkers = 5"}, "walkers is 5, wanted an even number from 4"),
    ({"rest": "[sigmas]\nankle = inf\nknee = inf\npelvis = inf\nfoot = inf"}, "one that is not"),
    ({"rest": "[sample]\nwalkers = 10_000\nmax_steps = 1_000_000"}, "149 GiB, wanted at most 8; t"),
    ({"rest": "[sample]\nmax_steps = 10\nthin_by = 20"}, "wanted at least thin_by"),
    ({"rest": "[hierarchy]\nper_subject = [1, {}]"}, "per_subject is .*; wanted a list of names"),
    ({"rest": '[hierarchy]\nper_clip = ["a\\u0000"]'}, "per_clip is .*; wanted a list of names"),
    (
        {"rest": "[prior.pelvis]\nhalf_life = { centre = inf }"},
        "centre is inf; wanted a finite numb",
    ),
    ({"rest": "[start]\npelvis.half_life = inf"}, "half_life is inf; wanted a finite number"),
]
BEYOND_SCHEMA += [  # and about a free parameter's bounds, neither too narrow nor too wide
    ({"free": f"foot.max_pitch = {{ {bounds} }}"}, f".free..*max_pitch.*{said}")
    for bounds, said in (
        ("low = 0.3, high = 0.3", "low < high"),
        ("low = 0.5, high = 0.1", "bounds are 0.5 to 0.1.*low < high"),
        ("low = inf", "low is inf; wanted a finite number"),
        ("high = 1e300", "high is 1e.300; wanted a finite number"),
        ("high = 1e30", "1e.30 apart, wanted .*; its rule has 0"),
        ("low = 0.5, high = 0.50000000001", "apart, wanted"),
        ("low = 0.0, high = 1e-300", "1e-300 apart, wanted 1.4e-06 to"),
        ("low = 1e-13, high = 1.0, scale = 'log'", "at most 1e.12 times the lower one"),
        ("low = 0.0, high = 0.5, scale = 'log'", "strictly between 0.0 and inf"),
    )
]


@functools.cache
def schema() -> Content:
    return experiment_schema()


@pytest.fixture(scope="module", autouse=True)
def presets_made_once() -> Iterator[None]:
    """Hundreds of experiments are read here: making their preset takes most of the time."""
    systems_made: dict[str, jaxik.FootIK] = {}

    def once(name: object, rig: None = None, *, faithful: object = False) -> jaxik.FootIK:
        key = f"{name!r} {faithful!r}"
        if key not in systems_made:
            systems_made[key] = preset_system(name, rig, faithful=faithful)
        return systems_made[key]

    preset_system = systems.preset_system
    with pytest.MonkeyPatch.context() as patch:
        for module in (systems, experiment_files):
            patch.setattr(module, "preset_system", once)
        yield


def is_valid(toml: str) -> bool:
    return jsonschema.Draft202012Validator(schema()).is_valid(tomllib.loads(toml))


def refusal(folder: Path, parts: Parts) -> str:
    """What the reader says of an experiment with these parts, and soon; nothing if it takes it."""
    path, begin = write(folder, **parts), time.process_time()
    try:
        loaded = experiment_files.load_experiment(path)
        loaded.space(loaded.starting_system())
    except ValueError as error:
        assert str(error).startswith(str(path)) and len(validation.in_one_line(error)) <= 1000
        return str(error)
    finally:
        assert time.process_time() - begin < 5.0
    return ""


def test_the_reader_says_what_is_wrong_and_the_schema_takes_the_same_experiments(tmp_path):
    mistakes = [({part: toml}, said) for part, rows in MISTAKES.items() for toml, said in rows]
    offenders = [
        (parts, answer)
        for parts, message in mistakes + PAIRS + BEYOND_SCHEMA
        if not re.search(f"experiment.toml.*{message}", answer := refusal(tmp_path, parts))
    ]
    assert offenders == []
    accepted = [parts for parts, _ in mistakes + PAIRS if is_valid(text(**parts))]
    assert accepted == [], "by the schema"
    refused = [p for p in VALID if refusal(tmp_path, p) or not is_valid(text(**p))]
    assert refused == []


def objects(schema: object) -> Iterator[Content]:
    """Every schema of a table inside a schema."""
    if isinstance(schema, Mapping):
        if schema.get("type") == "object":
            yield dict(schema)
        for part in schema.values():
            yield from objects(part)


def test_it_is_a_schema_that_json_can_hold_and_what_is_shipped_or_written_is_valid():
    jsonschema.Draft202012Validator.check_schema(schema())
    assert json.loads(json.dumps(schema(), allow_nan=False)) == schema()
    shipped = sorted((ROOT / "data" / "experiments").rglob("*.toml"))
    assert len(shipped) > 5
    for path in shipped:
        assert is_valid(path.read_text(encoding="utf-8")), path
    for preset in systems.all_presets():
        ik = preset.system()
        values = tomllib.loads(parameter_files.system_to_toml(ik, preset))
        tables = {stage: values[stage] for stage in systems.STAGES if stage in values}
        free: dict[str, Content] = {}
        for name in parameter_tree.declarations(ik):
            free.setdefault(name.partition(".")[0], {})[name.partition(".")[2]] = {}
        clips = [{"reference": "a", "terrain": "b"}]
        content: Any = preset.keys() | {"clips": clips, "free": free, "parameters": tables}
        assert jsonschema.Draft202012Validator(schema()).is_valid(content), preset


def test_the_schema_of_a_key_accepts_what_the_reader_accepts():
    offenders = []
    for table, key in ((table, key) for table, known in KEYS.items() for key in known):
        constraint = KEYS[table][key].constraint
        validator = jsonschema.Draft202012Validator(constraint.schema)
        for value in NUMBERS + OTHERS:
            if isinstance(value, float) and value.is_integer():
                continue  # JSON Schema counts 2.0 as a whole number
            if isinstance(value, list | dict) and KEYS[table][key].inner is not None:
                continue  # whose keys the reader checks one by one
            if validator.is_valid(value) != constraint.accepts(value):
                offenders.append((table, key, value))
    assert offenders == []


def test_every_key_has_a_meaning_a_parameter_its_range_and_the_defaults_are_those_of_the_reader():
    tables = [table for table in objects(schema()) if "properties" in table]
    assert len(tables) > 50
    for table in tables:
        for name, part in table["properties"].items():
            if name not in systems.STAGES:
                assert re.search(r"[.)]$", part["description"]), name
        assert table["additionalProperties"] is False
    limit = schema()["properties"]["parameters"]["properties"]["pelvis"]["properties"]["limit"]
    declared = parameter_tree.declarations(systems.preset_system("record"))["pelvis.limit"]
    assert declared.doc in limit["description"] and "Unit: m." in limit["description"]
    assert f"Range: {declared.low:g} to {declared.high:g}." in limit["description"]
    assert "inf m in ozz" in limit["description"]
    search = table_schema(SEARCH_KEYS)["properties"]
    assert search["agreement"]["description"].endswith(" Unit: cost.")
    assert "Unit" not in search["min_step_gain"]["description"]
    tables = schema()["properties"]
    assert tables["preset"]["default"] == "record" and tables["loss"]["default"] == "huber"
    assert tables["clips"]["items"]["properties"]["file_up"]["default"] == "y"
    assert tables["fit"]["properties"]["max_steps"]["default"] == 1000
    assert tables["fit"]["properties"]["search"]["properties"]["population"]["default"] == 64
    assert tables["sigmas"]["properties"]["ankle"]["default"] == 0.02
    assert "Default: inf." in tables["sigmas"]["properties"]["body"]["description"]


def test_the_page_on_experiment_files_names_every_key():
    page = (ROOT / "fitting" / "experiment" / "README.md").read_text(encoding="utf-8")
    section = page.partition("\n## Experiment files\n")[2].partition("\n## Parameter files\n")[0]
    for table in KEYS.keys() - {"search", "sample"}:  # which `jaxik schema` lists
        for key in KEYS[table]:
            word = key.rpartition(".")[2]
            assert re.search(rf"(?<!\w){word}\b", section), f"{table}: {key}"


# Numbers: both ends of a range are accepted, nothing beyond is

INF = math.inf
TOP = {"fps": (1, 1000), "independent_every": (0, 1e6), "seed": (0, 2**32 - 1), "holdout": (0, 0.9)}
SIGMAS = {kind: (LEAST_SIGMAS.get(kind, 1e-9), 1e9) for kind in experiment.SIGMAS}
CORRELATIONS = dict.fromkeys(ALL_SIGMA_KEYS.keys() - SIGMAS.keys(), (0, 0.999))
SEARCH = {
    "draws": (2, 100_000), "descents": (1, 1000), "agreement": (0, 1e6),
    "agreeing_starts": (1, 1000), "descent_steps": (1, 1000), "min_step_gain": (0, 1),
    "max_small_steps": (1, 1000), "max_rejected_steps": (1, 1000),
    "polish_max_rejected_steps": (1, 1000), "population": (17, 100_000), "generations": (1, 1000),
    "elite": (1, 100_000), "gauss_newton_children": (0, 63), "max_rounds": (1, 1000),
    "min_round_gain": (0, 1e6), "patience": (1, 1000), "sweep_values": (1, 1000),
    "sweep_tries": (1, 1000), "min_sweep_gain": (0, 1), "sweeps": (0, 1000),
}  # fmt: skip
SAMPLE = {
    "walkers": (4, 10_000), "max_steps": (1, 2**26), "min_steps": (0, 10**9),
    "thin_by": (1, 20_000), "check_every": (1, 10**6), "stop_at": (0, 1e12),
}  # fmt: skip
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "": TOP,
    "[sigmas]": SIGMAS | CORRELATIONS,
    "[prior]": {"spread": (1e-3, 1e3)},
    "[prior.foot]": {"max_pitch.spread": (1e-3, 1e3)},
    "[fit]": {"starts": (1, 1000), "max_steps": (1, 100_000)},
    "[fit.search]": SEARCH,
    "[sample]": SAMPLE,
}
OF_CLIPS = {
    "start": (0, 1e6), "end": (1e-3, 1e6), "terrain_scale": (1e-9, 1e6),
    "terrain_cell": (1e-3, 1e4), "sole": (0, 10),
}  # fmt: skip


def line(key: str, value: float) -> str:
    return f"{key} = {value if isinstance(value, int) else repr(float(value))}\n"


def beyond(low: float, high: float) -> list[float]:
    """Values outside a range: near its ends, far away, and no numbers."""
    step = 1 if isinstance(low, int) and isinstance(high, int) else 1e-12
    odd = [-1, 1e300, INF, -INF, math.nan, 10**400, 2**63]
    return [low - step if low else -step, high + max(step, 1e-9 * high), *odd]


@pytest.mark.parametrize("table", RANGES)
def test_a_number_is_accepted_up_to_the_ends_of_its_range(table, tmp_path):
    for key, (low, high) in RANGES[table].items():

        def answer(value: float, key: str = key) -> str:
            part = line(key, value)
            return refusal(tmp_path, {"rest": f"{table}\n{part}"} if table else {"top": part})

        assert [value for value in (low, high) if answer(value)] == [], key
        leaf = key.rpartition(".")[2]
        for value in beyond(low, high):
            if value == INF and key in SIGMAS:
                continue
            message = answer(value)
            assert table in message or "[prior]" in message, (key, value)
            wanted = rf"\b{leaf}\b.*wanted |wanted .*\b{leaf}\b"
            assert re.search(wanted, message), (key, value, message)


def test_a_number_of_a_clip_is_accepted_up_to_the_ends_of_its_range(tmp_path):
    for key, (low, high) in OF_CLIPS.items():
        for value in (low, high):
            assert refusal(tmp_path, {"clips": CLIP, "clip": line(key, value)}) == "", (key, value)
        for value in (-1e-9, high * 1.001, -1, INF, -INF, math.nan, 1e300):
            message = refusal(tmp_path, {"clips": CLIP, "clip": line(key, value)})
            assert re.search(rf"experiment.toml \[\[clips\]\]: {key} is .*wanted ", message), value


def test_every_number_of_the_format_has_a_range_here():
    assert SEARCH.keys() | {"max_steps"} == keys(SearchSettings).keys()
    assert SAMPLE.keys() == keys(SamplerSettings).keys()
    of_clips = {*OF_CLIPS, "scale"}  # which no .npz has
    for numbers, table in ((TOP, keys(Experiment)), (of_clips, keys(ClipEntry))):
        types = {key: declared.schema.get("type") for key, declared in table.items()}
        assert {*numbers} == {key for key in types if types[key] in ("number", "integer")}
    for settings in (SearchSettings, SamplerSettings):
        highest = [declared.schema["maximum"] for declared in keys(settings).values()]
        assert all(map(math.isfinite, highest))


def test_a_range_may_be_a_millionth_or_million_times_the_declared_one_and_steps_fit_into_memory(
    tmp_path,
):
    for bounds in ("low = 0.0, high = 1.5e-6", "high = 1e6", "low = 1e-9, high = 1, scale = 'log'"):
        path = write(tmp_path, free=f"foot.max_pitch = {{ {bounds} }}")
        loaded = experiment_files.load_experiment(path)
        (parameter,) = loaded.free_parameters(loaded.starting_system())
        assert parameter.low < parameter.high
    loaded = experiment_files.load_experiment(write(tmp_path))
    assert loaded.with_max_sample_steps(40_000).sample.max_steps == 40_000
    for steps in (0, -1, 10**9):
        with pytest.raises(ValueError, match="max_steps is "):
            loaded.with_max_sample_steps(steps)


def test_a_fixed_number_is_one_that_32_bits_hold_and_a_text_short_and_printable(tmp_path):
    for preset in systems.preset_names():
        ik = systems.preset_system(preset)
        name = next(iter(systems.parameter_tree.declarations(ik)))
        for value in (1e39, -1e39, math.nan, 10**400, "x", [], {}):
            with pytest.raises(ValueError, match=f"file: {name} (is|has shape) .*wanted "):
                systems.with_parameters(ik, {name: value}, "file")
        systems.with_parameters(ik, {name: 3e38}, "file")
        systems.with_parameters(ik, {name: INF}, "file")
        for value in (0.5, -1, 2**32, INF, True):
            with pytest.raises(ValueError, match="layers is .*; wanted a whole number from 0"):
                systems.with_parameters(ik, {"probe.layers": value}, "file")
    for key in ("name", "preset", "loss", "body"):
        for word in ("a\\u0000b", "a\\nb", "x" * 1001, "\\u202e"):
            message = refusal(tmp_path, {"top": f'{key} = "{word}"'})
            assert re.search(rf"experiment.toml: {key} is .*; wanted ", message), word
