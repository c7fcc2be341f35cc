"""Parameter files: a system as TOML."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.experiments import parameter_files
from fitting.experiments.systems import DEFAULT_PRESET, Preset, leaf_names
from jaxik.maths import parameter_tree
from support.clips import ODD

FAITHFUL = Preset("record", faithful=True)


def write_file(folder, text):
    path = folder / "parameters.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_parameter_convention_and_switch_is_read_back_exactly(tmp_path):
    per_leg = {"foot.max_roll": jnp.array([0.1, 0.2]), "pelvis.tick_hz": jnp.array(60.0)}
    ik = parameter_tree.replace(
        parameter_tree.replace(jaxik.presets.record(faithful=True), ODD), per_leg
    )
    ik = parameter_tree.replace(ik, {"leg.soften": jnp.nextafter(jnp.array(0.9), jnp.array(1.0))})
    back, preset = parameter_files.load_system(
        write_file(tmp_path, parameter_files.system_to_toml(ik, FAITHFUL))
    )
    assert preset == FAITHFUL
    for name in leaf_names(ik):
        np.testing.assert_array_equal(
            parameter_tree.get(back, name), parameter_tree.get(ik, name), err_msg=name
        )


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
    ik, preset = parameter_files.load_system(
        write_file(tmp_path, "lock.enabled = false\nleg.soften = 1\n")
    )
    assert preset == DEFAULT_PRESET
    changed = {"lock.enabled": False, "leg.soften": 1.0}
    expected = parameter_tree.replace(jaxik.presets.record(), changed)
    for name in leaf_names(ik):
        np.testing.assert_array_equal(
            parameter_tree.get(ik, name), parameter_tree.get(expected, name), err_msg=name
        )


def test_a_parameter_may_have_one_value_per_leg(tmp_path):
    ik, _ = parameter_files.load_system(write_file(tmp_path, "[foot]\nmax_pitch = [0.3, 0.4]\n"))
    np.testing.assert_array_equal(parameter_tree.get(ik, "foot.max_pitch"), [0.3, 0.4])


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
    with pytest.raises(ValueError, match="no.toml: no such file, wanted a parameter file"):
        parameter_files.load_system(tmp_path / "no.toml")
    with pytest.raises(ValueError, match="a folder, wanted a parameter file"):
        parameter_files.load_system(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="binary.toml: not TOML"):
        parameter_files.load_system(tmp_path / "binary.toml")
