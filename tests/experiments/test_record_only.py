"""Fits of what the game's record holds: nothing is lost between the fit and the bytes."""

import re
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from fitting.analysis import playback
from fitting.cli import main
from fitting.cli.commands import fits as commands
from fitting.experiments import (
    experiment_files,
    parameter_files,
    problems,
    record_only,
    systems,
)
from fitting.jobs import fits
from fitting.runtime.validation import flatten, read_toml
from fitting.studies import record_price, run_folder
from fitting.studies.fit import Fit
from jaxik import record
from jaxik.maths import parameter_tree
from support import experiments

TOP = 'preset = "record"\nfaithful = true\nbody = "adult"\n'
FREE = 'foot.max_pitch = {}\nlock.max_speed = {}\n"probe.toe_ls[1]" = {}\n'
TRUTH = experiments.ROOT / "data/clips/uneven_walk_truth.toml"


def restricted(tmp_path, **parts):
    parts = {"top": f"{TOP}record_only = true", "free": FREE} | parts
    return experiment_files.load_experiment(experiments.write(tmp_path, **parts))


def test_what_the_record_has_no_room_for_is_not_free_but_what_its_reader_assumes(tmp_path):
    other = "[parameters]\nlock.lock_half_life = 0.02\nprobe.limited = true\nfoot.max_roll = 0.2"
    experiment = restricted(tmp_path, rest=other)
    assert list(experiment.free) == ["foot.max_pitch", "probe.toe_ls[1]"]
    assert record_only.left_out(experiment) == ["lock.max_speed"]
    ik = experiment.starting_system()
    assert record.dropped(ik) == {}
    assert float(parameter_tree.get(ik, "foot.max_roll")) == pytest.approx(0.2)
    aside = record_only.set_aside(experiment)
    assert aside["lock.lock_half_life"] == ("0.02 s", "0.05 s") and "probe.limited" in aside


def test_a_restricted_experiment_is_the_same_when_read_again(tmp_path):
    of_both = "foot.max_pitch = {0}\nlock.max_speed = {0}\n"
    rest = f"[prior]\n{of_both.format('{ spread = 1.0 }')}[start]\n{of_both.format(0.4)}"
    experiment = restricted(tmp_path, rest=rest)
    assert list(experiment.start) == list(experiment.prior.named) == ["foot.max_pitch"]
    again = tmp_path / "again.toml"
    again.write_text(experiment_files.experiment_to_toml(experiment))
    loaded = experiment_files.load_experiment(again)
    for field in ("free", "parameters", "start", "prior"):
        assert getattr(loaded, field) == getattr(experiment, field)
    assert record_only.left_out(loaded) == []


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"top": "record_only = true"}, "preset = 'record' with faithful = false;"),
        ({"top": 'preset = "ozz"\nrecord_only = true'}, "preset = 'ozz' with faithful = false;"),
        ({"rest": '[rules]\npelvis = "SupportPelvis"'}, "others: {'pelvis': 'SupportPelvis'}"),
        ({"rest": "[hierarchy]\nscale_with_body = true"}, "same for every body"),
        ({"free": "lock.max_speed = {}"}, r"no room for any of \['lock.max_speed'\]; it has for"),
        ({"rest": "[parameters]\nfoot.max_roll = [0.1, 0.2]"}, "one value for all legs"),
    ],
)
def test_an_experiment_whose_fit_could_be_no_record_is_refused(tmp_path, parts, message):
    with pytest.raises(ValueError, match=rf"experiment.toml: .*{message}"):
        restricted(tmp_path, **parts)


def test_the_price_is_that_of_one_search_with_all_that_was_free(tmp_path, monkeypatch):
    rest = "[start]\nfoot.max_pitch = 0.5\ntarget.rise_half_life = 0.1"
    clip = "start = 1.0\nend = 1.2"
    free = 'foot.max_pitch = {}\n"probe.toe_ls[1]" = {}\ntarget.rise_half_life = {}\n'
    experiment = restricted(tmp_path, rest=rest, free=free, clips=experiments.CLIP + clip)
    problem = problems.make_problem(experiment)
    space = problem.space
    values = np.array([0.4, -0.05])
    u = space.pack(dict(zip(space.names, values, strict=True)))
    solution: Any = SimpleNamespace(u=u, names=space.names, values=values, interrupted=False)
    solution.cost = 3.0
    fitted = Fit(experiment, problem, solution, cast(Any, None))
    searches, lines = [], []

    def search(problem, settings, progress, start) -> Any:
        searches.append((settings.fit.starts, *problem.space.values(start)))
        return SimpleNamespace(u=start + [0.0, 0.0, 2.0], cost=2.0, interrupted=False)

    monkeypatch.setattr(record_price, "search", search)
    price = record_price.measure(fitted)
    assert price is not None and searches == [pytest.approx((1, 0.4, -0.05, 0.1))]
    assert (price.left_out, price.cost, price.whole_cost) == (("target.rise_half_life",), 3.0, 2.0)
    (scene,) = problem.data
    play = playback.play(scene, playback.run(fitted.ik, scene))
    ankle = np.sqrt(np.mean(play.errors["ankle"] ** 2))
    assert price.errors["ankle"][0] == pytest.approx(ankle)
    assert price.errors["ankle"][1] != pytest.approx(ankle)
    text, section = fits._price_of_record(fitted, None, lines.append)
    assert lines == ["what the record costs: a search in which target.rise_half_life are free, too"]
    said = "The cost is 3; with these free, too, a search from there ends at 2."
    assert (
        said in "".join(text) and said in section[1] and "not target.rise_half_life: " in section[1]
    )
    assert f"| Ankle position | {100 * ankle:.4g} cm |" in section[2]


def test_the_command_restricts_an_experiment_that_it_fits(tmp_path, monkeypatch):
    fitted = []
    monkeypatch.setattr(commands.jobs, "fit", lambda entry, *_, **__: fitted.append(entry))
    monkeypatch.setattr(commands.status, "of_fit", lambda _: 0)
    words = ["fit", str(experiments.write(tmp_path, top=TOP, free=FREE)), "-o", str(tmp_path)]
    assert main.main([*words, "--record-only"]) == main.main(words) == 0
    assert [experiment.record_only for experiment in fitted] == [True, False]


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of the knee
def test_a_fit_of_the_record_alone_is_the_same_from_its_bytes_and_names_its_price(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    stages = {k: v for k, v in read_toml(TRUTH, "a truth").items() if isinstance(v, dict)}
    known = flatten({name: table for name, table in stages.items() if name != "noise"}, 2)
    free = {"foot.max_pitch", "target.rise_half_life"}
    fixed = "".join(f"{name} = {value}\n" for name, value in known.items() if name not in free)
    path = experiments.write(
        tmp_path,
        top=TOP,
        free="".join(f"{name} = {{}}\n" for name in sorted(free)),
        rest=f"[parameters]\n{fixed}[sigmas]\nankle = 0.002\nknee = 0.002\npelvis = 0.002\n"
        "[fit]\nstarts = 1\n[fit.search]\nagreeing_starts = 1",
    )
    main.main(["fit", str(path), "--record-only", "-o", "run"])
    summary = (tmp_path / "run" / run_folder.SUMMARY).read_text()
    found = re.search(r"The cost is (\S+); .* search from there ends at (\S+)\.\n", summary)
    assert found is not None
    assert float(found[2]) < 0.5 * float(found[1]), "the half-life alone made most of what is left"
    assert main.main(["record", "to-bytes", "run/parameters.toml", "-o", "game.bin"]) == 0
    assert main.main(["record", "to-toml", "game.bin", "-o", "back.toml"]) == 0
    (ik, _), (back, _) = map(parameter_files.load_system, ("run/parameters.toml", "back.toml"))
    for name in systems.leaf_names(ik):
        values = [parameter_tree.get(each, name) for each in (back, ik)]
        np.testing.assert_allclose(*values, rtol=1e-6, err_msg=name)
