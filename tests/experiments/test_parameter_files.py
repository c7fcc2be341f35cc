"""Parameter files: a system as TOML, and as settings of ozz, Unreal and Mec in their units."""

import json
import math
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import fitting
from fitting import jobs
from fitting.cli import main
from fitting.experiment import experiment_files, originals, parameter_files, systems
from fitting.experiment.originals import ORIGINALS
from fitting.experiment.systems import DEFAULT_PRESET, Preset, leaf_names
from jaxik import FootIK, presets
from jaxik.maths import parameter_tree
from jaxik.record.parameters import half_life_of_gain
from jaxik.stages.lean import NoLean
from support.clips import ODD
from support.experiments import write
from support.problems import parameter

FAITHFUL = Preset("record", faithful=True)


def write_file(folder, text):
    path = folder / "parameters.toml"
    path.write_text(text, encoding="utf-8")
    return path


def assert_same_system(ik: FootIK, expected: FootIK) -> None:
    for name in leaf_names(ik):
        np.testing.assert_array_equal(
            parameter_tree.get(ik, name), parameter_tree.get(expected, name), err_msg=name
        )


def test_everything_is_read_back_exactly_and_what_is_missing_is_that_of_the_preset(tmp_path):
    odd = ODD | {"foot.max_roll": jnp.array([0.1, 0.2]), "pelvis.limit": jnp.array(0.2)}
    odd |= {"leg.soften": jnp.nextafter(jnp.array(0.9), jnp.array(1.0))}
    ik = parameter_tree.replace(presets.record(faithful=True), odd)
    text = parameter_files.system_to_toml(ik, FAITHFUL)
    back, preset = parameter_files.load_system(write_file(tmp_path, text))
    assert preset == FAITHFUL
    assert_same_system(back, ik)
    text = "lock.enabled = false\nleg.soften = 1\n[foot]\nmax_pitch = [0.3, 0.4]\n"
    ik, preset = parameter_files.load_system(write_file(tmp_path, text))
    assert preset == DEFAULT_PRESET
    changed = {"lock.enabled": False, "leg.soften": 1.0, "foot.max_pitch": [0.3, 0.4]}
    assert_same_system(ik, parameter_tree.replace(presets.record(), changed))


def test_options_are_read_back_and_only_true_or_false(tmp_path):
    ik = presets.stride()
    for name, is_on in parameter_tree.options(ik).items():
        ik = parameter_tree.with_option(ik, name, not is_on)
    text = parameter_files.system_to_toml(ik, Preset("stride"))
    back, _ = parameter_files.load_system(write_file(tmp_path, text))
    on = {name for name, is_on in parameter_tree.options(back).items() if is_on}
    probe = {"probe.check_support", "probe.remember_swings", "target.absorb_jumps"}
    assert on == probe | {"probe.simple_in_flight", "leg.allow_stretch", "foot.bend_toes"}
    assert parameter_tree.options(back).keys() - on == {"probe.limited", "probe.slide_to_support"}
    with pytest.raises(ValueError, match="probe.limited is 0; wanted true or false"):
        parameter_files.load_system(write_file(tmp_path, "probe.limited = 0"))


def test_gains_of_an_earlier_release_are_half_lives(tmp_path):
    for text, tick_hz in (("", 30.0), ("pelvis.tick_hz = 60.0\n", 60.0)):
        ik, _ = parameter_files.load_system(write_file(tmp_path, f"{text}pelvis.on_gain = 0.2"))
        half_life = float(parameter_tree.get(ik, "pelvis.half_life"))
        assert half_life == pytest.approx(half_life_of_gain(0.2, tick_hz))
    for text, message in (
        ("pelvis.on_gain = nan", "pelvis.half_life is nan; wanted a number"),
        ("pelvis.on_gain = true", "pelvis.half_life is True; wanted a number"),
        ("preset = 'stride'\npelvis.on_gain = 0.1", "unknown key 'pelvis.on_gain'"),
        ("preset = 'stride'\npelvis.tick_hz = 60.0", "unknown key 'pelvis.tick_hz'"),
        ("leg.tick_hz = 60.0", "unknown key 'leg.tick_hz'"),
    ):
        with pytest.raises(ValueError, match=message):
            parameter_files.load_system(write_file(tmp_path, text))
    fixed = "lean.slide_off_gain = 0.1\nlean.tick_hz = 60.0"
    free = "pelvis.on_gain = { high = 0.5 }\nlean.gain = {}"
    experiment = experiment_files.load_experiment(
        write(tmp_path, free=free, rest=f"[parameters]\n{fixed}")
    )
    assert experiment.parameters == {"lean.slide_off_half_life": half_life_of_gain(0.1, 60.0)}
    low, high = (half_life_of_gain(gain, 30.0) for gain in (0.95, 0.01))
    assert experiment.free == {
        "pelvis.half_life": {"low": half_life_of_gain(0.5, 30.0), "high": high},
        "lean.half_life": {"low": low, "high": high},
    }


def test_a_mistake_is_reported_with_what_was_wanted(tmp_path):
    for text, message in (
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
    ):
        with pytest.raises(ValueError, match=message):
            parameter_files.load_system(write_file(tmp_path, text))


class FixedLean(NoLean):
    """A rule from outside jaxik: no lean, with a parameter of its own."""

    angle: parameter_tree.Leaf = parameter(0.1, "rad", 0.0, 0.5)


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
    with pytest.raises(ValueError, match="FootIK is not a rule of a stage; the stages are"):
        fitting.register_rule(FootIK)


# Settings of the originals

# Unreal counts in centimetres, Unity in metres and degrees with x to the right.
HANDS = {
    "ozz": (
        {
            "foot_heigh_": 0.12, "weight_": 1.0, "soften_": 0.97, "auto_character_height_": True,
            "pelvis_correction_": False, "two_bone_ik_": True, "aim_ik_": False,
            "kCharacterRayHeightOffset.y": 10.0, "kFootRayHeightOffset.y": 0.5,
        },
        {
            "target.foot_height": 0.12, "leg.weight": 1.0, "foot.weight": 1.0, "leg.soften": 0.97,
            "root.enabled": True, "pelvis.enabled": False, "leg.enabled": True,
            "foot.enabled": False, "root.ray_up": 10.0, "probe.ray_up": 0.5,
        },
    ),
    "unreal": (
        {
            "m_IKCapsuleHalfHeight": 88.0, "m_IKTraceDistance": 55.0, "m_IKAdjustFootOffset": 3.0,
            "m_IKInterpSpeed": 13.0, "m_IKHipInterpSpeed": 7.0,
        },
        {
            "pelvis.half_height": 0.88, "probe.ray_up": 0.88, "probe.ray_down": 0.55,
            "target.adjust": 0.03, "effector.speed": 13.0, "pelvis.speed": 7.0,
        },
    ),
    "mec": (
        {
            "Plant Foot": True, "IK Hint Offset": [0.1, 0.2, 0.3], "Foot Offset Dist": 0.4,
            "Foot Length": 0.22, "Foot Half Width": 0.04, "Foot Height": 0.11,
            "Foot Rotation Limit": 60.0, "Transition Time": 0.25, "Extra Ray Distance Check": 0.15,
            "Set Extra Ray Distance Check Automatically": True,
            "Foot Distance from Ground Threshold": 0.13, "Extra Ray Distance Check Min": 0.01,
            "Extra Ray Distance Check Max": 0.35, "Adjust Pelvis Vertically": True,
            "Damp Pelvis": False, "Max Leg Length": 0.9, "Min Leg Length": 0.45,
            "Pelvis Adjustment Speed": 8.0, "SetActive": [True, False], "SetPlantBlendWeight": 0.5,
        },
        {
            "lock.plant": True, "leg.hint_offset": [-0.1, 0.2, 0.3], "probe.ray_up": 0.4,
            "probe.foot_length": 0.22, "probe.half_width": 0.04, "target.foot_height": 0.11,
            "foot.max_tilt": math.pi / 3, "effector.transition_time": 0.25, "probe.extra": 0.15,
            "probe.by_height": True, "probe.stable_height": 0.13, "probe.extra_min": 0.01,
            "probe.extra_max": 0.35, "pelvis.enabled": True, "pelvis.damp": False,
            "pelvis.max_length": 0.9, "pelvis.min_length": 0.45, "pelvis.speed": 8.0,
            "probe.active": [True, False], "lock.plant_weight": 0.5,
        },
    ),
}  # fmt: skip


def system_of(name: str) -> FootIK:
    """The original with the parameters that are written above."""
    return parameter_tree.replace(Preset(name, faithful=True).system(), HANDS[name][1])


@pytest.mark.parametrize("name", HANDS)
def test_settings_written_by_hand_are_these_parameters_and_back(name):
    settings, parameters = HANDS[name]
    ik = originals.to_ik(settings, name)
    for leaf, value in parameters.items():
        assert parameter_tree.get(ik, leaf).tolist() == pytest.approx(value, rel=1e-6), leaf
    written = originals.to_settings(system_of(name), name)
    assert settings.keys() == {setting.name for setting in ORIGINALS[name].settings}
    assert written == {key: pytest.approx(value, rel=1e-6) for key, value in settings.items()}


@pytest.mark.parametrize("suffix", originals.SUFFIXES)
@pytest.mark.parametrize("name", HANDS)
def test_a_file_of_settings_comes_back_as_the_same_parameters(name, suffix, tmp_path):
    ours, theirs = tmp_path / "ours.toml", tmp_path / f"theirs{suffix}"
    preset = Preset(name, faithful=True)
    ours.write_text(parameter_files.system_to_toml(system_of(name), preset), encoding="utf-8")
    jobs.export(ours, theirs, system=name)
    back = tmp_path / "back.toml"
    jobs.export(theirs, back)
    (ik, _), (again, kept) = map(parameter_files.load_system, (ours, back))
    assert kept == preset
    for slot in parameter_tree.slots(ik):
        value = parameter_tree.get(again, slot.name).tolist()
        assert value == pytest.approx(slot.value.tolist(), rel=1e-6), slot.name


def test_what_an_original_cannot_hold_is_named_and_left_out_only_if_wanted(tmp_path, capsys):
    ours, theirs = tmp_path / "ours.toml", tmp_path / "theirs.json"
    ours.write_text('preset = "unreal"\n[effector]\nlatch = false\n[target]\nadjust = 0.02\n')
    words = ["export", str(ours), "--as", "unreal", "-o", str(theirs)]
    assert main.main(words) == main.MISTAKE
    (line,) = capsys.readouterr().err.splitlines()
    assert "rules.fade = SpeedFade (NoFade)" in line and "effector.latch = off (on)" in line
    assert "--drop" in line and not theirs.exists()
    with pytest.warns(UserWarning, match="unreal has no setting for rules.fade"):
        jobs.export(ours, theirs, system="unreal", drop=True)
    assert json.loads(theirs.read_text())["settings"]["m_IKAdjustFootOffset"] == pytest.approx(2.0)
    # What changes nothing is not missed.
    unused = {"root.half_life": 0.3, "probe.max_step_up": 0.5}
    ik = parameter_tree.replace(presets.unreal(faithful=True), unused)
    assert originals.dropped(ik, ORIGINALS["unreal"]) == {}
    ik = parameter_tree.replace(ik, {"root.enabled": True})
    assert set(originals.dropped(ik, ORIGINALS["unreal"])) == {"root.enabled", "root.half_life"}
    for name, changed, message in (
        ("unreal", {"probe.ray_up": 0.8}, "m_IKCapsuleHalfHeight is one setting, but pelvis.half_"),
        ("ozz", {"leg.soften": [1.0, 0.9]}, "soften_ is one for all legs"),
        ("unreal", {"probe.ray_down": math.inf}, "m_IKTraceDistance is finite"),
    ):
        ik = parameter_tree.replace(Preset(name, faithful=True).system(), changed)
        with pytest.raises(ValueError, match=message):
            originals.to_settings(ik, name)


def test_a_wrong_table_of_settings_costs_one_sentence(tmp_path):
    path, output = tmp_path / "theirs.toml", tmp_path / "ours.toml"
    unreal = 'system = "unreal"\n[settings]\n'
    for text, message in (
        ('system = "unity"\n[settings]\n', "no settings of 'unity'; there are those of"),
        (f"{unreal}m_IKTrace = 1.0\n", "nearest is 'm_IKTraceDistance'"),
        (f'{unreal}m_IKTraceDistance = "x"\n', "wanted a number"),
        (f"{unreal}m_IKTraceDistance = [1.0, 2.0]\n", "wanted ()"),
        ('system = "mec"\n[settings]\n"Plant Foot" = 1\n', "wanted true or false"),
        ('[settings]\n"Plant Foot" = true\n', "system is missing"),
        (f'{unreal}[units]\nm_IKTraceDistance = "m"\n', "has it in 'cm'"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=f"theirs.toml.*{re.escape(message)}"):
            jobs.export(path, output)
        assert not output.exists(), text
    path = path.with_suffix(".csv")
    for damaged in ("[" * 100_000, '"' + "x" * 200_000):
        path.write_text(f"system,setting,value,unit\nozz,foot_heigh_,{damaged},m\n")
        with pytest.raises(ValueError, match="not a table of settings"):
            originals.load_settings(path)


@pytest.mark.filterwarnings("ignore:parameters do not tell the knee's axis")
def test_parameters_go_through_json_and_records_and_come_back(tmp_path):
    ours = tmp_path / "ours.toml"
    ours.write_text('preset = "record"\nfaithful = true\n[pelvis]\nlimit = 0.25\n')
    chain = [ours, *(tmp_path / name for name in ("a.json", "b.bin", "c.csv", "d.toml"))]
    for source, output in zip(chain, chain[1:], strict=False):
        jobs.export(source, output)
    ik, preset = parameter_files.load_system(chain[-1])
    assert preset == Preset("record", faithful=True)
    assert float(parameter_tree.get(ik, "pelvis.limit")) == pytest.approx(0.25)
    plain = tmp_path / "plain.json"
    ours.write_text('preset = "ozz"\nleg_length = 0.9\n')
    jobs.export(ours, plain)
    content = json.loads(plain.read_text(), parse_constant=pytest.fail)
    assert content["pelvis"]["limit"] is None and content["leg_length"] == 0.9
    ik, _ = parameter_files.load_system(plain)
    assert math.isinf(parameter_tree.get(ik, "pelvis.limit"))
    for system, name in ((None, "a.txt"), ("ozz", "a.bin")):
        with pytest.raises(ValueError, match="wanted a name that ends in one of"):
            jobs.export(Path("no.toml"), tmp_path / name, system=system)
