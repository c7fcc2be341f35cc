"""Parameter files: a system as TOML."""

import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxik
from fitting.experiments import experiment_files, parameter_files, systems
from fitting.experiments.systems import DEFAULT_PRESET, Preset, leaf_names
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, parameter
from jaxik.stages.lean import NoLean
from support.clips import ODD
from support.experiments import write

FAITHFUL = Preset("record", faithful=True)


def write_file(folder, text):
    path = folder / "parameters.toml"
    path.write_text(text, encoding="utf-8")
    return path


def assert_same_system(ik: jaxik.FootIK, expected: jaxik.FootIK) -> None:
    for name in leaf_names(ik):
        np.testing.assert_array_equal(
            parameter_tree.get(ik, name), parameter_tree.get(expected, name), err_msg=name
        )


def test_every_parameter_convention_and_switch_is_read_back_exactly(tmp_path):
    odd = ODD | {"foot.max_roll": jnp.array([0.1, 0.2]), "pelvis.tick_hz": jnp.array(60.0)}
    odd |= {"leg.soften": jnp.nextafter(jnp.array(0.9), jnp.array(1.0))}
    ik = parameter_tree.replace(jaxik.presets.record(faithful=True), odd)
    text = parameter_files.system_to_toml(ik, FAITHFUL)
    back, preset = parameter_files.load_system(write_file(tmp_path, text))
    assert preset == FAITHFUL
    assert_same_system(back, ik)


def test_options_are_read_back_and_only_true_or_false(tmp_path):
    ik = jaxik.presets.stride()
    for name, is_on in parameter_tree.options(ik).items():
        ik = parameter_tree.with_option(ik, name, not is_on)
    text = parameter_files.system_to_toml(ik, Preset("stride"))
    back, _ = parameter_files.load_system(write_file(tmp_path, text))
    assert parameter_tree.options(back) == {
        "probe.limited": False,
        "probe.check_support": True,
        "probe.remember_swings": True,
        "probe.slide_to_support": False,
    }
    with pytest.raises(ValueError, match="probe.limited is 0; wanted true or false"):
        parameter_files.load_system(write_file(tmp_path, "probe.limited = 0"))


def test_missing_values_are_those_of_the_preset(tmp_path):
    text = "lock.enabled = false\nleg.soften = 1\n[foot]\nmax_pitch = [0.3, 0.4]\n"
    ik, preset = parameter_files.load_system(write_file(tmp_path, text))
    assert preset == DEFAULT_PRESET
    changed = {"lock.enabled": False, "leg.soften": 1.0, "foot.max_pitch": [0.3, 0.4]}
    assert_same_system(ik, parameter_tree.replace(jaxik.presets.record(), changed))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "parameters.toml: nothing is in it; wanted a preset, rules or parameters"),
        ("# a comment", "nothing is in it"),
        ("lock = [[", "not TOML"),
        ("lock = " + 100_000 * "[", "not TOML: nested too deeply"),
        ("preset = 'recrod'", r"no preset named 'recrod'; there are \['mec', 'ozz', 'rec"),
        ("preset = 3", "no preset named 3"),
        ("preset = 'stride'\nfaithful = true", "'stride' has no other original; faithful is for"),
        ("faithful = 1", "parameters.toml: faithful is 1; wanted true or false"),
        ("[lok]\nenabled = true", "unknown key 'lok'; nearest is 'lock' of"),
        ("[lock]\nspeed = 1.0", "unknown key 'lock.speed'; nearest is 'lock.max_speed'"),
        ("lock = 3", "unknown key 'lock'; nearest is 'lock.enabled'"),
        ("[lock]", "unknown key 'lock'; nearest is 'lock.enabled'"),
        ("[lock]\nmax_speed = 'fast'", "lock.max_speed is 'fast'; wanted a number"),
        ("[lock]\nmax_speed = true", "lock.max_speed is True; wanted a number"),
        ("[lock]\nmax_speed = nan", "lock.max_speed is nan; wanted a number"),
        ("[lock]\nmax_speed = 1979-05-27", "lock.max_speed is .*; wanted a number"),
        ("[lock]\nmax_speed = [[1], [1, 2]]", "lock.max_speed is .*; wanted a number"),
        ("[lock]\nmax_speed = []", r"lock.max_speed has shape \(0,\); wanted \(\)"),
        ("[lock]\nmax_speed = [[1.0]]", r"lock.max_speed has shape \(1, 1\); wanted \(\)"),
        ("[lock]\nenabled = 1", "lock.enabled is 1; wanted true or false"),
        ("[probe]\ntoe_ls = [0.1, 0.2]", r"probe.toe_ls has shape \(2,\); wanted \(3,\)"),
    ],
)
def test_a_mistake_is_reported_with_what_was_wanted(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        parameter_files.load_system(write_file(tmp_path, text))


def test_a_missing_file_or_one_that_is_not_text_is_rejected(tmp_path):
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    for name, message in (
        ("no.toml", "no.toml: no such file, wanted a parameter file"),
        (".", "a folder, wanted a parameter file"),
        ("binary.toml", "binary.toml: not TOML"),
    ):
        with pytest.raises(ValueError, match=message):
            parameter_files.load_system(tmp_path / name)


class FixedLean(NoLean):
    """A rule from outside jaxik: no lean, with a parameter of its own."""

    angle: Leaf = parameter(0.1, unit="rad", low=0.0, high=0.5, doc="Changes nothing.")


def test_a_rule_is_known_to_parameter_files_and_experiments_once_it_is_registered(
    tmp_path, monkeypatch
):
    experiment = write(tmp_path, top='rules.lean = "FixedLean"', free="lean.angle = {}")
    with pytest.raises(ValueError, match="lean has no rule 'FixedLean'"):
        experiment_files.load_experiment(experiment)
    monkeypatch.setitem(systems.STAGES, "lean", dict(systems.STAGES["lean"]))
    assert fitting.register_rule(FixedLean) is FixedLean
    loaded = experiment_files.load_experiment(experiment)
    assert type(loaded.starting_system().lean) is FixedLean and list(loaded.free) == ["lean.angle"]
    path = write_file(tmp_path, 'rules.lean = "FixedLean"\nlean.angle = 0.2\n')
    ik, _ = parameter_files.load_system(path)
    assert type(ik.lean) is FixedLean
    assert float(parameter_tree.get(ik, "lean.angle")) == pytest.approx(0.2)


def test_a_class_that_implements_no_stage_is_refused():
    with pytest.raises(ValueError, match="FootIK is no rule of a stage; the stages are"):
        fitting.register_rule(jaxik.FootIK)
