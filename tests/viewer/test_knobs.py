"""Sliders, steps back and files: what a viewer does without solving anything."""

import threading

import pytest

import jaxik
from fitting.experiments import parameter_files
from fitting.experiments.systems import Preset
from fitting.problem.free_parameters import free_parameter
from fitting.viewer import saving
from fitting.viewer.knobs import Knob, knobs
from fitting.viewer.latest import Latest
from fitting.viewer.tuning import PAUSE, Tuning
from jaxik import presets, record
from jaxik.maths import parameter_tree

FAITHFUL = Preset("record", faithful=True)


@pytest.fixture(scope="module")
def ik() -> jaxik.FootIK:
    return presets.record()


@pytest.fixture(scope="module")
def by_name(ik) -> dict[str, Knob]:
    return {knob.name: knob for knob in knobs(ik)}


def test_every_parameter_and_every_switch_has_a_knob(ik, by_name):
    declared = set(parameter_tree.declarations(ik))
    switches = {slot.name for slot in parameter_tree.slots(ik) if slot.value.dtype == bool}
    assert {knob.leaf for knob in by_name.values()} == declared | switches
    toes = [name for name in by_name if name.startswith("probe.toe_ls")]
    assert toes == [f"probe.toe_ls[{i}]" for i in range(3)]
    for knob in by_name.values():
        assert knob.low <= knob.shown(ik) <= knob.high
        assert 0 < knob.step <= (knob.high - knob.low) / 100


@pytest.mark.parametrize("name", ["pelvis.limit", "probe.toe_ls[2]", "lock.enabled"])
def test_a_knob_changes_its_own_number_and_no_other(name, ik, by_name):
    knob = by_name[name]
    value = (not knob.read(ik)) if knob.is_switch else 0.5 * (knob.low + knob.high)
    moved = knob.write(ik, value)
    assert knob.read(moved) == pytest.approx(value)
    others = [other for other in by_name.values() if other is not knob]
    assert [other.read(moved) for other in others] == [other.read(ik) for other in others]


def test_a_number_is_within_its_range_however_a_page_rounds_it_or_refused(ik, by_name):
    knee, limit = by_name["leg.max_knee_angle"], by_name["pelvis.limit"]
    assert knee.read(knee.write(ik, 3.1415927)) == knee.high < 3.1415927
    with pytest.raises(ValueError, match="pelvis.limit is 99; wanted from"):
        limit.write(ik, 99.0)


def test_the_order_of_two_parameters_is_kept(ik, by_name):
    names = parameter_tree.declarations(ik)
    (upper, declared), *_ = [(n, d) for n, d in names.items() if d.above is not None]
    high, low = by_name[upper], by_name[f"{upper.rpartition('.')[0]}.{declared.above}"]
    assert high.above == low.leaf and low.below == (high.leaf,)
    assert high.read(high.write(ik, high.low)) == low.read(ik)
    assert low.read(low.write(ik, low.high)) == high.read(ik)


def test_fitted_parameters_have_the_range_of_their_fit(ik):
    free = [free_parameter(ik, "foot.max_pitch", low=0.1, high=0.2)]
    fitted = [knob for knob in knobs(ik, free=free) if knob.is_free]
    assert [(knob.name, knob.low, knob.high) for knob in fitted] == [("foot.max_pitch", 0.1, 0.2)]


def test_undo_redo_and_reset(ik, by_name):
    knob, other = by_name["pelvis.limit"], by_name["foot.max_pitch"]
    tuning = Tuning({"fitted": ik, "default": presets.ozz()})
    for i, now in enumerate((0.0, 0.1, 0.2)):  # one drag
        tuning.change(knob.write(ik, 0.1 + 0.01 * i), knob.name, now)
    dragged = tuning.ik
    tuning.change(other.write(dragged, 0.2), other.name, 0.3)
    tuning.undo()
    assert tuning.ik is dragged
    tuning.undo()
    assert tuning.ik is ik and not tuning.can_undo
    tuning.redo()
    assert tuning.ik is dragged and tuning.can_redo
    tuning.reset("default")
    assert tuning.ik is tuning.starts["default"] and not tuning.can_redo
    tuning.undo()
    assert tuning.ik is dragged


def test_a_pause_begins_a_new_step(ik, by_name):
    knob, tuning = by_name["pelvis.limit"], Tuning({"default": ik})
    first = knob.write(ik, 0.1)
    tuning.change(first, knob.name, 0.0)
    tuning.change(knob.write(ik, 0.2), knob.name, 2 * PAUSE)
    tuning.undo()
    assert tuning.ik is first


def test_what_is_saved_is_read_again_and_stays_when_more_is_saved(tmp_path):
    ik = presets.record(faithful=True)
    knob = next(knob for knob in knobs(ik) if knob.name == "pelvis.limit")
    said = saving.save(tmp_path, knob.write(ik, 0.123), FAITHFUL)
    saving.save(tmp_path, ik, FAITHFUL)
    loaded, preset = parameter_files.load_system(tmp_path / "tuned.toml")
    content = (tmp_path / "tuned.bin").read_bytes()
    for read in (loaded, record.to_ik(record.from_bytes(content))):
        assert knob.read(read) == pytest.approx(0.123)
    assert preset == FAITHFUL and (tmp_path / "tuned_2.toml").exists()
    assert "knee" in said[-1]  # the bytes hold more than parameters


def test_a_record_that_would_lose_something_is_not_written(tmp_path):
    ik = parameter_tree.replace(presets.record(faithful=True), {"leg.soften": 0.9})
    (_, refused) = saving.save(tmp_path, ik, FAITHFUL)
    assert "No record is written" in refused and "leg.soften = 0.9" in refused
    assert [path.name for path in tmp_path.iterdir()] == ["tuned.toml"]
    said = saving.save(tmp_path, ik, FAITHFUL, drop=True)
    assert any("leg.soften = 0.9" in line for line in said)
    assert (tmp_path / "tuned_2.bin").stat().st_size == 128


def test_other_rules_make_no_record(tmp_path):
    (_, refused) = saving.save(tmp_path, presets.ozz(), Preset("ozz"))
    assert "only those of 'record' make one" in refused


def test_only_the_newest_request_is_worked_on():
    began, go_on = threading.Event(), threading.Event()
    newest, done = [0], []

    def work() -> None:
        value = newest[0]
        began.set()
        go_on.wait(10)
        done.append(value)

    latest = Latest(work)
    latest.ask()
    assert began.wait(10)
    for value in range(1, 50):
        newest[0] = value
        latest.ask()
    go_on.set()
    assert latest.wait(10)
    latest.close()
    assert done == [0, 49]
