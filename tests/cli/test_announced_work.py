"""What a fit and a sampling do is announced before it is done, in order."""

import threading
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib.figure import Figure

from fitting import jobs
from fitting.analysis import playback
from fitting.experiments import problems
from fitting.inference.optimisation import search
from fitting.inference.profiles import profiling
from fitting.inference.sampling import posterior
from fitting.report import fit_report, posterior_report
from fitting.report.identifiability import sections
from fitting.runtime import activity
from fitting.studies import run_folder
from fitting.studies.posterior import replay
from support import quick
from support.experiments import CLIP, write
from support.watching import Recorder

pytestmark = pytest.mark.slow
READING, PREPARING = "Reading the clip and its ground", "Preparing what is compared"
PLAYING = "Playing the clips with the "
FIT = [
    READING,
    PREPARING,
    "Preparing the programs of the search",
    "Searching from up to 6 starts",
    "Following 2 parameters over their ranges",
    "Writing the motions and numbers of the fit",
    f"{PLAYING}fitted system",
    f"{PLAYING}system before the fit",
    "Drawing the curves of the parameters",
    "Drawing hill",
    "Measuring where limits are in effect",
    "Finding what determines 2 parameters",
    "Writing the page",
    "Finishing the pictures",
]
SAMPLE = [
    READING,
    PREPARING,
    "Sampling up to 40 steps of 8 walkers",
    "Placing 8 walkers",
    "Summing up the chain",
    "Playing 160 draws of the posterior",
    "Writing the posterior",
    "Drawing the posterior",
]
LONG = {  # what takes long, and how the work is called that must be going on then
    (problems, "load_clip_data"): READING,
    (problems, "make_scene"): PREPARING,
    (search, "_begin"): "Preparing the programs",
    (search, "search_from"): "Searching",
    (profiling, "lowest"): "Following",
    (run_folder, "save_clip"): "Writing the motions",
    (playback, "run"): ("Playing", "Measuring", "Finding"),
    (fit_report, "_draw_clip"): "Drawing hill",
    (fit_report, "_draw_profiles"): "Drawing the curves",
    (fit_report.limit_activity, "measure"): "Measuring",
    (sections, "find_evidence"): "Finding",
    (fit_report.fit_page, "write"): "Writing the page",
    (posterior, "_check"): "Sampling",
    (posterior, "_posterior"): "Summing up",
    (replay._Clip, "add"): "Playing",
    (posterior_report.posterior_plots, "corner"): "Drawing the posterior",
}


class Watcher(Recorder):
    """Also writes down what is done, with the innermost work that is going on."""

    def __init__(self) -> None:
        super().__init__()
        self.going_on: list[str] = []
        self.done: set[tuple[str, str]] = set()

    def began(self, work: activity.Work) -> None:
        super().began(work)
        self.going_on.append(work.title)

    def ended(self, work: activity.Work) -> None:
        super().ended(work)
        assert self.going_on.pop() == work.title

    def watch(self, patch: pytest.MonkeyPatch, place: ModuleType | type, name: str) -> None:
        """Writes down each call of a function."""
        function = getattr(place, name)

        def called(*arguments, **named):
            if threading.current_thread() is threading.main_thread():  # others keep nobody waiting
                self.done.add((name, self.going_on[-1] if self.going_on else "nothing announced"))
            return function(*arguments, **named)

        patch.setattr(place, name, called)


@pytest.fixture(scope="module")
def watchers(tmp_path_factory) -> list[Watcher]:
    """Those of a fit and of its sampling."""
    folder = tmp_path_factory.mktemp("files")
    path = write(
        folder, top="name = 'hill'", clips=CLIP, clip="start = 1.0\nend = 1.5",
        rest="[sample]\nwalkers = 8\nstop_at = 1e9\nmax_steps = 40",
    )  # fmt: skip
    watchers = []
    for job in (lambda: jobs.fit(path, folder / "run"), lambda: jobs.sample(folder / "run")):
        watcher = Watcher()
        with pytest.MonkeyPatch.context() as patch, activity.watched_by(watcher):
            patch.setattr(problems, "residuals_of_scenes", quick.residuals_of_scenes)
            patch.setattr(Figure, "savefig", lambda self, path, **look: Path(path).touch())
            for place, name in LONG:
                watcher.watch(patch, place, name)
            job()
        watchers.append(watcher)
    return watchers


def test_everything_is_announced_in_its_order(watchers):
    fitting, sampling = watchers
    assert list(dict.fromkeys(fitting.titles)) == FIT
    assert list(dict.fromkeys(sampling.titles)) == SAMPLE
    assert not fitting.going_on and not sampling.going_on


def test_what_takes_long_is_done_within_its_announcement(watchers):
    done = set.union(*(watcher.done for watcher in watchers))
    assert {name for name, _ in done} == {name for _, name in LONG}
    wanted = {name: title for (_, name), title in LONG.items()}
    assert [pair for pair in done if not pair[1].startswith(wanted[pair[0]])] == []
