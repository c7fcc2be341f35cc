"""The range of every number in an experiment file: its ends are accepted, nothing beyond is."""

import math
import re
import time

import pytest

from fitting.experiments import experiment_files, systems
from fitting.experiments.schema import keys
from fitting.inference.optimisation.settings import SearchSettings
from fitting.inference.sampling.settings import SamplerSettings
from fitting.inference.settings import describe
from fitting.runtime import validation
from support.experiments import CLIP, write

INF = math.inf
TOP = {"fps": (1, 1000), "independent_every": (0, 1e6), "seed": (0, 2**32 - 1)}
SIGMAS = dict.fromkeys(experiment_files.KINDS, (1e-9, 1e9))
CORRELATIONS = dict.fromkeys(("correlation", *experiment_files.CORRELATIONS), (0, 0.999))
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
    "start": (0, 1e6), "end": (1e-3, 1e6), "terrain_scale": (1e-9, 1e6), "terrain_cell": (1e-3, 1e4)
}  # fmt: skip


def refusal(folder, **parts: str) -> str:
    """What the loader says of an experiment, and soon; nothing if it takes it."""
    begin = time.process_time()
    try:
        experiment_files.load_experiment(write(folder, **parts))
    except ValueError as error:
        assert str(error).startswith(f"{folder / 'experiment.toml'}")
        assert len(validation.in_one_line(error)) <= 1000
        return str(error)
    finally:
        assert time.process_time() - begin < 5.0
    return ""


def line(key: str, value: float) -> str:
    return f"{key} = {value if isinstance(value, int) else repr(float(value))}\n"


def beyond(low: float, high: float) -> list[float]:
    """Values outside a range: near its ends, far away, and no numbers."""
    step = 1 if isinstance(low, int) and isinstance(high, int) else 1e-12
    odd = [-1, -(10**9), 1e300, -1e300, INF, -INF, math.nan, 10**400, 2**63]
    return [low - step if low else -step, high + max(step, 1e-9 * high), *odd]


@pytest.mark.parametrize("table", RANGES)
def test_a_number_is_accepted_up_to_the_ends_of_its_range(table, tmp_path):
    for key, (low, high) in RANGES[table].items():

        def answer(value: float, key: str = key) -> str:
            part = line(key, value)
            return refusal(tmp_path, **{"rest": f"{table}\n{part}"} if table else {"top": part})

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
            assert refusal(tmp_path, clips=CLIP, clip=line(key, value)) == "", (key, value)
        for value in (-1e-9, high * 1.001, -1, INF, -INF, math.nan, 1e300):
            message = refusal(tmp_path, clips=CLIP, clip=line(key, value))
            assert re.search(rf"experiment.toml \[\[clips\]\]: {key} is .*wanted ", message), value


def test_every_number_of_the_format_has_a_range_here():
    assert SEARCH.keys() | {"max_steps"} == describe(SearchSettings).keys()
    assert SAMPLE.keys() == describe(SamplerSettings).keys()
    assert {**SIGMAS, **CORRELATIONS}.keys() == experiment_files.SIGMA_KEYS.keys()
    of_clips = {*OF_CLIPS, "scale"}  # which no .npz has
    for numbers, table in ((TOP, experiment_files.TOP_KEYS), (of_clips, keys.CLIP_KEYS)):
        types = {key: constraint.schema.get("type") for key, constraint in table.items()}
        assert {*numbers} == {key for key in types if types[key] in ("number", "integer")}
    for settings in (SearchSettings, SamplerSettings):
        assert all(math.isfinite(declared.high) for declared in describe(settings).values())


def test_a_range_may_be_a_millionth_or_a_million_times_the_declared_one(tmp_path):
    for bounds in ("low = 0.0, high = 1.5e-6", "high = 1e6", "low = 1e-9, high = 1, scale = 'log'"):
        path = write(tmp_path, free=f"foot.max_pitch = {{ {bounds} }}")
        loaded = experiment_files.load_experiment(path)
        (parameter,) = loaded.free_parameters(loaded.starting_system())
        assert parameter.low < parameter.high


def test_a_fixed_number_is_one_that_32_bits_hold():
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


@pytest.mark.parametrize("key", ["name", "preset", "loss", "body"])
def test_a_text_is_short_and_printable(key, tmp_path):
    for word in ("a\\u0000b", "a\\nb", "x" * 1001, "\\u202e"):
        message = refusal(tmp_path, top=f'{key} = "{word}"')
        assert re.search(rf"experiment.toml: {key} is .*; wanted ", message), word


def test_more_steps_of_a_chain_than_fit_into_memory_are_refused(tmp_path):
    loaded = experiment_files.load_experiment(write(tmp_path))
    assert loaded.with_max_sample_steps(40_000).sample.max_steps == 40_000
    for steps in (0, -1, 10**9):
        with pytest.raises(ValueError, match="max_steps is "):
            loaded.with_max_sample_steps(steps)
