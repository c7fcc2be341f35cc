"""Rules: what they say of themselves, and their names in experiments and parameter files."""

import dataclasses
import json
import math

import numpy as np
import pytest

import jaxik
from fitting.cli import main
from fitting.experiments import experiment_files, known_values, parameter_files, problems, systems
from fitting.experiments.ablations import Ablation
from fitting.studies import run_folder, translation
from fitting.studies.animations import Animation, AnimationFiles
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.stages import contact, leg, pelvis
from support.experiments import ROOT, write
from support.runs import invented_fit, save

PRESETS = ("record", "ozz", "unreal", "mec")
RULES = 'rules = { pelvis = "CapsulePelvis", contact = "IdleContact" }'
FREE = "pelvis.speed = {}\nfoot.max_pitch = { low = 0.1 }"


def write_parameters(folder, text):
    path = folder / "parameters.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_fields_of_all_rules_have_a_sentence_of_meaning():
    for rules in systems.STAGES.values():
        for rule in rules.values():
            docs = parameter_tree.docs(rule())
            assert list(docs) == [field.name for field in dataclasses.fields(rule)], rule.__name__
            for name, sentence in docs.items():
                assert sentence[0].isupper() and sentence.endswith("."), f"{rule.__name__}.{name}"
            for declaration in parameter_tree.declarations(rule()).values():
                assert declaration.doc in docs.values()
                assert declaration.unit and declaration.low < declaration.high < math.inf


def test_printing_a_preset_lists_its_rules_and_parameters_with_units():
    lines = repr(presets.unreal()).splitlines()
    assert lines[0] == "FootIK"
    assert "  pelvis      CapsulePelvis" in lines
    assert "    speed        15 1/s" in lines and "    half_height  0.9 m" in lines
    assert "    max_knee_angle  3.142 rad (180°)" in lines
    assert "  lean        NoLean" in lines


def test_all_rules_of_the_presets_are_known_at_their_stages():
    assert list(systems.STAGES) == [field.name for field in dataclasses.fields(jaxik.FootIK)]
    for name in PRESETS:
        for stage, rule in systems.rule_names(systems.preset_system(name)).items():
            assert rule in systems.STAGES[stage]
    assert systems.STAGES["leg"]["PoleLeg"] is leg.PoleLeg
    assert not [n for rules in systems.STAGES.values() for n in rules if n.startswith("Abstract")]


def test_a_new_rule_has_its_defaults_and_a_present_one_keeps_its_values():
    ozz = presets.ozz()
    changed = systems.with_rules(ozz, {"pelvis": "CapsulePelvis", "probe": "FootProbe"}, "here")
    assert type(changed.pelvis) is pelvis.CapsulePelvis
    np.testing.assert_array_equal(
        parameter_tree.get(changed, "pelvis.speed"), pelvis.CapsulePelvis().speed
    )
    assert changed.probe is ozz.probe and np.isinf(parameter_tree.get(changed, "probe.ray_down"))
    assert systems.changed_rules(changed, ozz) == {"pelvis": "CapsulePelvis"}
    assert systems.changed_rules(ozz, presets.ozz()) == {}


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"pelvs": "LowestPelvis"}, "here: unknown key 'pelvs'; nearest is 'pelvis' of"),
        ({"pelvis": "LowPelvis"}, "here: pelvis has no rule 'LowPelvis'; it has .'LowestPelvis',"),
        ({"pelvis": "TwoBone"}, "pelvis has no rule 'TwoBone'"),
        ({"pelvis": ["LowestPelvis"]}, r"pelvis has no rule \['LowestPelvis'\]"),
    ],
)
def test_an_unknown_stage_or_rule_is_an_error_that_lists_what_exists(rules, message):
    with pytest.raises(ValueError, match=message):
        systems.with_rules(presets.record(), rules, "here")


# Parameter files


def test_rules_and_values_round_trip_through_a_parameter_file(tmp_path):
    names = {"pelvis": "LegLengthPelvis", "leg": "PoleLeg", "contact": "IdleContact"}
    ik = systems.with_rules(presets.record(), names, "here")
    ik = parameter_tree.replace(ik, {"pelvis.max_length": 0.91, "contact.idle_speed": 0.07})
    text = parameter_files.system_to_toml(ik)
    back, preset = parameter_files.load_system(write_parameters(tmp_path, text))
    assert preset == systems.DEFAULT_PRESET and systems.rule_names(back) == systems.rule_names(ik)
    for name in systems.leaf_names(ik):
        np.testing.assert_array_equal(
            parameter_tree.get(back, name), parameter_tree.get(ik, name), err_msg=name
        )


def test_the_rules_of_a_preset_itself_are_not_written():
    presets_of_files = [systems.Preset(name) for name in PRESETS]
    presets_of_files += [systems.Preset(name, faithful=True) for name in ("record", "mec")]
    for preset in presets_of_files:
        assert "rules" not in parameter_files.system_to_toml(preset.system(), preset)


WRONG_RULES = [
    ("rules = 3", "rules is 3; wanted a table"),
    ("rules = { pelvs = 'x' }", r"\[rules\]: unknown key 'pelvs'; nearest is 'pelvis'"),
    ("rules = { pelvis = 'Low' }", r"\[rules\]: pelvis has no rule 'Low'; it has \["),
]


@pytest.mark.parametrize(("text", "message"), WRONG_RULES)
def test_wrong_rules_of_a_file_are_an_error(tmp_path, text, message):
    with pytest.raises(ValueError, match=f"parameters.toml.*{message}"):
        parameter_files.load_system(write_parameters(tmp_path, text))
    with pytest.raises(ValueError, match=message):
        experiment_files.load_experiment(write(tmp_path, top=text))


def test_parameters_of_an_exchanged_rule_are_unknown(tmp_path):
    text = "[rules]\npelvis = 'CapsulePelvis'\n[pelvis]\non_gain = 0.1"
    with pytest.raises(ValueError, match="unknown key 'pelvis.on_gain'"):
        parameter_files.load_system(write_parameters(tmp_path, text))
    read = experiment_files.load_experiment(write(tmp_path, top=RULES))
    with pytest.raises(ValueError, match="no parameter named 'pelvis.on_gain'"):
        problems.make_problem(read)


def test_a_system_with_other_rules_cannot_become_a_record(tmp_path, capsys):
    path = write_parameters(tmp_path, "faithful = true\n[rules]\npelvis = 'CapsulePelvis'\n")
    words = ["record", "to-bytes", str(path), "-o", str(tmp_path / "a.bin")]
    assert main.main(words) == main.MISTAKE
    assert "rules {'pelvis': 'CapsulePelvis'}; only those of 'record'" in capsys.readouterr().err
    assert not (tmp_path / "a.bin").exists()


# Experiments


def test_an_experiment_can_exchange_rules_and_free_their_parameters(tmp_path):
    rest = "[parameters]\ncontact.idle_speed = 0.5"
    read = experiment_files.load_experiment(write(tmp_path, top=RULES, free=FREE, rest=rest))
    assert read.rules == {"pelvis": "CapsulePelvis", "contact": "IdleContact"}
    problem = problems.make_problem(read)
    base = problem.space.unpack(problem.space.start)
    assert type(base.pelvis) is pelvis.CapsulePelvis
    assert type(base.contact) is contact.IdleContact
    assert float(parameter_tree.get(base, "contact.idle_speed")) == 0.5
    assert problem.space.names == ("pelvis.speed", "foot.max_pitch")


def test_the_truth_of_an_experiment_is_read_with_its_rules(tmp_path):
    (tmp_path / "truth.toml").write_text("[pelvis]\nspeed = 3.5\n")
    clip = "truth = 'truth.toml'"
    read = experiment_files.load_experiment(write(tmp_path, top=RULES, free=FREE, clip=clip))
    assert known_values.load_known_values(read) == {"pelvis.speed": 3.5}


def test_rules_are_kept_through_a_run(tmp_path, undrawn):
    fit, run = invented_fit(tmp_path, '[rules]\ncontact = "IdleContact"\n'), tmp_path / "run"
    save(run, fit)
    reloaded, summary = run_folder.load_fit(run)
    assert reloaded.rules == fit.experiment.rules == {"contact": "IdleContact"}
    assert json.loads((run / run_folder.FIT).read_text())["parameters"] == summary["parameters"]
    ik, _ = parameter_files.load_system(run / run_folder.PARAMETERS)
    assert systems.rule_names(ik) == systems.rule_names(reloaded.starting_system())
    fitted = [float(parameter_tree.get(ik, name)) for name in fit.solution.names]
    np.testing.assert_allclose(fitted, fit.solution.values, rtol=1e-12)


def test_a_translation_keeps_the_rules_of_its_target(tmp_path, monkeypatch):
    def lift(animation, ik):
        base = animation.clip
        return None, base.with_motion(base.positions_ws + [0.0, 0.1, 0.0], base.rotations_ws)

    monkeypatch.setattr(Animation, "solve", lift)
    path = tmp_path / "mine.toml"
    path.write_text("leg.soften = 0.9\n[rules]\npelvis = 'CapsulePelvis'\n[pelvis]\nspeed = 4.0\n")
    clip = ROOT / "data" / "clips" / "uneven_walk_base.npz"
    ground = ROOT / "data" / "terrains" / "uneven_walk.ply"
    files = AnimationFiles(clip, ground)
    source, target = (
        translation.load_named_system(text, rig=files.flat_clip.rig) for text in ("ozz", str(path))
    )
    request = translation.TranslationRequest(source, target, (files,), {"pelvis.speed": {}}, 5.0)
    prepared = translation.prepare(request, tmp_path / "run")
    assert prepared.experiment.rules == {"pelvis": "CapsulePelvis"}
    assert prepared.experiment.parameters == {"pelvis.speed": 4.0, "leg.soften": 0.9}
    assert prepared.experiment.clips[0].truth is None, "its parameters are others"
    again = prepared.experiment.starting_system()
    assert systems.rule_names(again) == systems.rule_names(target.ik)
    fitted = prepared.problem.space.unpack(prepared.problem.space.start)
    assert systems.rule_names(fitted) == systems.rule_names(target.ik)


# Variants

WITHOUT = """
[[without]]
name = "pelvis"
rules = { pelvis = "CapsulePelvis" }
[[without]]
name = "locks"
parameters = { lock.enabled = false, "leg.soften" = 1.0 }
"""


def test_variants_are_read_with_their_rules_and_parameters_and_kept_by_a_run(tmp_path):
    read = experiment_files.load_experiment(write(tmp_path, rest=WITHOUT))
    assert read.without == (
        Ablation("pelvis", {"pelvis": "CapsulePelvis"}, {}),
        Ablation("locks", {}, {"lock.enabled": False, "leg.soften": 1.0}),
    )
    (tmp_path / "again.toml").write_text(experiment_files.experiment_to_toml(read))
    assert experiment_files.load_experiment(tmp_path / "again.toml").without == read.without


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("name = 'a'", "a: changes nothing"),
        ("name = 'a'\nrules = { leg = 'TwoBone' }", "a: changes nothing"),
        ("rules = { pelvis = 'CapsulePelvis' }", "a variant without a name"),
        ("name = ' '\nparameters = { leg.soften = 1 }", "a variant without a name"),
        ("name = 3", "name is 3; wanted a text"),
        ("name = 'a'\nrule = 3", "unknown key 'rule'; nearest is 'rules'"),
        ("name = 'a'\nrules = 3", "rules is 3; wanted a table"),
        ("name = 'a'\nrules = { leg = 'x' }", "a: rules: leg has no rule 'x'; it has"),
        ("name = 'a'\nrules = { lg = 'x' }", "a: rules: unknown key 'lg'"),
        ("name = 'a'\nparameters = { leg.softn = 1 }", "a: parameters: unknown key 'leg.softn'"),
        ("name = 'a'\nparameters = { leg.soften = 'x' }", "leg.soften is 'x'; wanted a number"),
        ("name = 'all rules'\nparameters = { leg.soften = 1 }", "already is a variant named 'all"),
    ],
)
def test_a_wrong_variant_is_refused(tmp_path, line, message):
    with pytest.raises(ValueError, match=f"experiment.toml.*{message}"):
        experiment_files.load_experiment(write(tmp_path, rest=f"[[without]]\n{line}"))


def test_variants_that_are_no_tables_or_have_one_name_are_refused(tmp_path):
    for top, message in (
        ("without = 3", r"without is 3; wanted \[\[without\]\], one for each variant"),
        ("without = [3]", r"\[\[without\]\] is 3; wanted a table"),
    ):
        with pytest.raises(ValueError, match=f"experiment.toml.*{message}"):
            experiment_files.load_experiment(write(tmp_path, top=top))
    table = "[[without]]\nname = 'a'\nparameters = { leg.soften = 1 }\n"
    with pytest.raises(ValueError, match="experiment.toml.*a variant named 'a'"):
        experiment_files.load_experiment(write(tmp_path, rest=2 * table))
