"""The live viewer in a browser: it loads, sliders move parameters, and there is a way back."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fitting.problem.space import free_parameter
from fitting.viewer import session_of_run, views
from fitting.viewer.views import Address
from support import runs
from support.browsers import launch, needs_chromium
from support.watching import listening

WINDOW = {"width": 720, "height": 420}  # small, for software has to draw it
LONG = 300.0  # s, on a busy machine

pytest.importorskip("viser", reason='needs `pip install "jaxik[view]"`')
playwright = pytest.importorskip(
    "playwright.sync_api", reason='needs `pip install "jaxik[browser]"`'
)
pytestmark = needs_chromium


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    runs.save(folder, runs.with_clips(runs.invented_fit(folder)))
    return folder


@pytest.fixture(scope="module")
def viewer(run) -> Iterator[Any]:
    lines: list[str] = []
    session = session_of_run(run)
    system = next(iter(session.starts.values()))
    session = dataclasses.replace(session, free=(free_parameter(system, "leg.weight"),))
    with listening(lines.append), views.opened(session, run, Address(port=0)) as shown:
        assert shown.wait(LONG)
        (line,) = lines
        shown.url = next(word for word in line.split() if word.startswith("http"))
        yield shown


@pytest.fixture(scope="module")
def page(viewer) -> Iterator[Any]:
    """The page, loaded; at the end nothing has gone wrong, and nothing came from elsewhere."""
    problems: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = launch(driver)
        page = browser.new_page(viewport=WINDOW)
        page.set_default_timeout(1000 * LONG)
        page.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda r: None if is_own(r.url, viewer.url) else problems.append(r.url))
        page.goto(viewer.url)
        page.get_by_text("Cost", exact=False).first.wait_for()
        yield page
        browser.close()
    assert problems == []


def is_own(url: str, address: str) -> bool:
    """Whether an address belongs to the page or is data within it."""
    return url.startswith((address, f"blob:{address}", "data:"))


def slider(page: Any, label: str) -> Any:
    """The slider with this label."""
    element = page.locator("label").get_by_text(label, exact=True).get_attribute("for")
    return page.locator(f'[id="{element}"] [role="slider"]')


def drag(page: Any, label: str, pixels: int) -> None:
    """Drags a slider as a hand does, in several moves."""
    thumb = slider(page, label)
    thumb.hover()  # waits until it stands still
    box = thumb.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.down()
    for part in (0.3, 0.6, 1.0):
        page.mouse.move(x + part * pixels, y)
    page.mouse.up()


def until(page: Any, condition: Any) -> None:
    """Waits until something holds."""
    for _ in range(int(10 * LONG)):
        if condition():
            return
        page.wait_for_timeout(100)
    raise AssertionError("waited in vain")


def feet(viewer: Any) -> np.ndarray:
    """The feet that the page shows now."""
    assert viewer.wait(LONG)
    return viewer.solved.motion.feet.points


def test_it_listens_to_this_machine_only(viewer):
    assert viewer.url.startswith("http://127.0.0.1:")


def test_a_dragged_slider_moves_the_feet_and_undo_brings_them_back(viewer, page):
    before, first = feet(viewer), viewer.tuning.ik
    drag(page, "leg.weight", -300)
    until(page, lambda: viewer.tuning.ik is not first)
    until(page, lambda: viewer.tuning.ik.leg.weight == 0.0)
    until(page, lambda: np.abs(feet(viewer) - before).max() > 0.01)
    while viewer.tuning.ik is not first:  # a slow hand makes several steps
        steps = viewer.tuning.ik
        page.get_by_role("button", name="Undo").click()
        until(page, lambda steps=steps: viewer.tuning.ik is not steps)
    assert viewer.tuning.ik is first
    until(page, lambda: np.array_equal(feet(viewer), before))


def test_time_is_scrubbed_and_plays(viewer, page):
    drag(page, "Frame", 400)
    last = str(viewer.solver.animation.frames.dt.size - 1)
    until(page, lambda: slider(page, "Frame").get_attribute("aria-valuenow") == last)
    page.get_by_label("Play").click()
    until(page, lambda: slider(page, "Frame").get_attribute("aria-valuenow") != last)
    page.get_by_label("Play").click()


def test_save_writes_what_is_shown(viewer, page, run):
    page.get_by_role("button", name="Save parameters and record").click()
    page.get_by_text("Parameters are in").wait_for()
    assert (run / "tuned.toml").exists()
    assert (run / "tuned.bin").exists() or page.get_by_text("No record is written").is_visible()
