"""Rules: what they say of themselves, and their names in experiments and parameter files."""

import dataclasses
import math

import numpy as np
import pytest

import jaxik
from fitting.experiment import experiment_files, parameter_files, problems, systems
from fitting.experiment.file_tables import Ablation
from fitting.studies import translation
from fitting.studies.animations import Animation, AnimationFiles
from jaxik import presets
from jaxik.maths import parameter_tree
from jaxik.stages import contact, leg, pelvis
from support.experiments import ROOT, write

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
    assert parameter_tree.get(changed, "pelvis.speed") == pelvis.CapsulePelvis().speed
    assert changed.probe is ozz.probe and np.isinf(parameter_tree.get(changed, "probe.ray_down"))
    assert systems.changed_rules(changed, ozz) == {"pelvis": "CapsulePelvis"}
    assert systems.changed_rules(ozz, presets.ozz()) == {}


@pytest.mark.parametrize(
    ("preset", "stage", "name", "values"),
    [
        ("record", "contact", "IdleContact", {"contact.idle_speed": 0.0}),
        ("unreal", "contact", "IdleContact", {"contact.idle_speed": 0.1}),
        ("unreal", "contact", "StandingContact", {"contact.idle_speed": math.inf}),
        ("stride", "warp", "NoWarp", {"warp.min_scale": 1.0, "warp.max_scale": 1.0}),
        ("ozz", "target", "ContactTarget", {"target.max_slope": 0.0, "target.foot_height": 0.1}),
        ("mec", "target", "ContactTarget", {"target.max_slope": 0.0, "target.foot_height": 0.085}),
        ("mec", "target", "SoleTarget", {"target.max_slope": 1.5, "target.foot_height": 0.12}),
        ("record", "effector", "FoundEffector", {"effector.if_found": True}),
        ("ozz", "effector", "DirectEffector", {"effector.if_found": False}),
        ("mec", "leg", "HintLeg", {"leg.to_hint": True}),
    ],
)
def test_a_rule_that_has_been_merged_into_another_one_keeps_its_name_in_files(
    tmp_path, preset, stage, name, values
):
    text = f"preset = '{preset}'\n[rules]\n{stage} = '{name}'"
    ik, _ = parameter_files.load_system(write_parameters(tmp_path, text))
    assert {leaf: parameter_tree.get(ik, leaf) for leaf in values} == pytest.approx(values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rules = 3", "rules is 3; wanted a table"),
        ("rules = { pelvs = 'x' }", r"\[rules\]: unknown key 'pelvs'; nearest is 'pelvis' of"),
        ("rules = { pelvis = 'Low' }", "pelvis has no rule 'Low'; it has .*'LowestPelvis',"),
        ("rules = { pelvis = 'TwoBone' }", "pelvis has no rule 'TwoBone'"),
        ("rules = { pelvis = ['LowestPelvis'] }", r"pelvis has no rule \['LowestPelvis'\]"),
        ("rules = { pelvis = 'CapsulePelvis' }\npelvis.half_life = 0.1", "key 'pelvis.half_life'"),
    ],
)
def test_a_rule_or_parameter_that_is_unknown_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=f"parameters.toml.*{message}"):
        parameter_files.load_system(write_parameters(tmp_path, text))


# Parameter files


def test_rules_and_values_round_trip_through_a_parameter_file(tmp_path):
    names = {"pelvis": "LegLengthPelvis", "leg": "PoleLeg", "contact": "IdleContact"}
    ik = systems.with_rules(presets.record(), names, "here")
    ik = parameter_tree.replace(ik, {"pelvis.max_length": 0.91, "contact.idle_speed": 0.07})
    text = parameter_files.system_to_toml(ik)
    back, preset = parameter_files.load_system(write_parameters(tmp_path, text))
    assert preset == systems.DEFAULT_PRESET and systems.rule_names(back) == systems.rule_names(ik)
    for name in systems.leaf_names(ik):
        leaves = (parameter_tree.get(tree, name) for tree in (back, ik))
        np.testing.assert_array_equal(*leaves, err_msg=name)


def test_the_rules_of_a_preset_itself_are_not_written():
    for name, faithful in (*((name, False) for name in PRESETS), ("record", True), ("mec", True)):
        preset = systems.Preset(name, faithful=faithful)
        assert "rules" not in parameter_files.system_to_toml(preset.system(), preset)


# Experiments


def test_an_experiment_can_exchange_rules_and_free_their_parameters(tmp_path):
    rest = "[parameters]\ncontact.idle_speed = 0.5"
    read = experiment_files.load_experiment(write(tmp_path, top=RULES, free=FREE, rest=rest))
    assert read.rules == {"pelvis": "CapsulePelvis", "contact": "IdleContact"}
    problem = problems.make_problem(read)
    base = problem.space.unpack(problem.space.start)
    assert type(base.pelvis) is pelvis.CapsulePelvis
    assert type(base.contact) is contact.StandingContact
    assert float(parameter_tree.get(base, "contact.idle_speed")) == 0.5
    assert problem.space.names == ("pelvis.speed", "foot.max_pitch")


def test_the_truth_of_an_experiment_is_read_with_its_rules(tmp_path):
    (tmp_path / "truth.toml").write_text("[pelvis]\nspeed = 3.5\n")
    clip = "truth = 'truth.toml'"
    read = experiment_files.load_experiment(write(tmp_path, top=RULES, free=FREE, clip=clip))
    assert problems.load_known_values(read) == {"pelvis.speed": 3.5}


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


def test_rules_and_variants_with_their_rules_and_parameters_are_read_and_kept(tmp_path):
    read = experiment_files.load_experiment(
        write(tmp_path, top="rules.contact = 'IdleContact'", rest=WITHOUT)
    )
    assert read.without == (
        Ablation("pelvis", {"pelvis": "CapsulePelvis"}, {}),
        Ablation("locks", {}, {"lock.enabled": False, "leg.soften": 1.0}),
    )
    (tmp_path / "again.toml").write_text(experiment_files.experiment_to_toml(read))
    again = experiment_files.load_experiment(tmp_path / "again.toml")
    assert again.without == read.without and again.rules == read.rules != {}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("name = 'a'", "a: changes nothing"),
        ("name = 'a'\nrules = { leg = 'TwoBone' }", "a: changes nothing"),
        ("name = ' '\nparameters = { leg.soften = 1 }", "a variant without a name"),
        ("name = 3", "name is 3; wanted a text"),
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
    table = "[[without]]\nname = 'a'\nparameters = { leg.soften = 1 }\n"
    for parts, message in (
        ({"top": "without = 3"}, r"without is 3; wanted \[\[without\]\], one for each variant"),
        ({"top": "without = [3]"}, r"\[\[without\]\] is 3; wanted a table"),
        ({"rest": 2 * table}, "a variant named 'a'"),
    ):
        with pytest.raises(ValueError, match=f"experiment.toml.*{message}"):
            experiment_files.load_experiment(write(tmp_path, **parts))
