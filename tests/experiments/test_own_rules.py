"""Rules from outside jaxik, known by name once they are registered."""

import pytest

import fitting
import jaxik
from fitting.experiments import experiment_files, parameter_files, systems
from jaxik.maths import parameter_tree
from jaxik.maths.parameter_tree import Leaf, parameter
from jaxik.stages.lean import NoLean
from support.experiments import write


class FixedLean(NoLean):
    """No lean, with a parameter of its own."""

    angle: Leaf = parameter(0.1, unit="rad", low=0.0, high=0.5, doc="Changes nothing.")


@pytest.fixture
def registered(monkeypatch):
    """`FixedLean`, registered for one test."""
    monkeypatch.setitem(systems.STAGES, "lean", dict(systems.STAGES["lean"]))
    return fitting.register_rule(FixedLean)


def test_a_registered_rule_is_known_to_parameter_files(registered, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text('rules.lean = "FixedLean"\nlean.angle = 0.2\n', encoding="utf-8")
    ik, _ = parameter_files.load_system(path)
    assert type(ik.lean) is registered
    assert float(parameter_tree.get(ik, "lean.angle")) == pytest.approx(0.2)


def test_a_registered_rule_is_known_to_experiments(registered, tmp_path):
    path = write(tmp_path, top='rules.lean = "FixedLean"', free="lean.angle = {}")
    experiment = experiment_files.load_experiment(path)
    assert type(experiment.starting_system().lean) is registered
    assert list(experiment.free) == ["lean.angle"]


def test_a_rule_that_is_not_registered_is_unknown(tmp_path):
    with pytest.raises(ValueError, match="lean has no rule 'FixedLean'"):
        experiment_files.load_experiment(write(tmp_path, top='rules.lean = "FixedLean"'))


def test_a_class_that_implements_no_stage_is_refused():
    with pytest.raises(ValueError, match="FootIK is no rule of a stage; the stages are"):
        fitting.register_rule(jaxik.FootIK)
