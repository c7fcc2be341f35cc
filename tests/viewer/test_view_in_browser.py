"""The live viewer in a browser: it loads, sliders move parameters, and there is a way back."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fitting.clips import load_clip
from fitting.problem.space import free_parameter
from fitting.viewer import session_of_run, views
from fitting.viewer.server import Address, Server
from support import runs
from support.browsers import launch, needs_chromium

WINDOW = {"width": 1200, "height": 640}
LONG = 60.0  # s, on a busy machine

playwright = pytest.importorskip(
    "playwright.sync_api", reason='needs `pip install "jaxik[browser]"`'
)
pytestmark = needs_chromium


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    runs.save(folder, runs.with_own_files(folder))
    return folder


@pytest.fixture(scope="module")
def server(run) -> Iterator[Server]:
    session = session_of_run(run)
    system = next(iter(session.starts.values()))
    session = dataclasses.replace(session, free=(free_parameter(system, "leg.weight"),))
    with views.opened(session, run, Address(port=0)) as server:
        yield server


@pytest.fixture(scope="module")
def page(server) -> Iterator[Any]:
    """The page, loaded; at the end nothing has gone wrong, and nothing came from elsewhere."""
    problems: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = launch(driver)
        page = browser.new_page(viewport=WINDOW)
        page.set_default_timeout(1000 * LONG)
        page.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda r: None if is_own(r.url, server.url) else problems.append(r.url))
        page.goto(server.url)
        page.get_by_text("Cost", exact=False).first.wait_for()
        yield page
        browser.close()
    assert problems == []


def is_own(url: str, address: str) -> bool:
    """Whether an address belongs to the page or is data within it."""
    return url.startswith((address, f"blob:{address}", "data:"))


def ankles(page: Any) -> str:
    """Where they are in the frame that is shown."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.evaluate("document.getElementById('view').dataset.ankles")


def until(page: Any, sentence: str) -> None:
    """Waits until the page says something of the solution."""
    words = json.dumps(sentence)
    page.wait_for_function(f"document.getElementById('live-status').textContent.includes({words})")


def test_a_moved_slider_moves_the_feet_and_undo_brings_them_back(page):
    page.locator("#time").fill("5")
    before, slider = ankles(page), page.get_by_label("leg.weight", exact=True)
    value = slider.input_value()
    slider.fill("0.5")
    until(page, "Live:")
    moved = ankles(page)
    slider.fill("0.2")  # without a pause: one step
    page.wait_for_function(f"document.getElementById('view').dataset.ankles !== {moved!r}")
    undo = page.get_by_role("button", name="Undo").last
    while undo.is_enabled():  # a slow hand makes several steps
        page.keyboard.press("Control+z")
    until(page, "As fitted")
    assert ankles(page) == before != moved and slider.input_value() == value
    page.get_by_role("button", name="Redo").click()
    until(page, "Live:")
    page.get_by_role("button", name="before", exact=True).click()
    until(page, "before ")
    page.get_by_role("button", name="fitted", exact=True).click()
    until(page, "As fitted")
    assert ankles(page) == before


def test_what_a_system_senses_is_drawn_on_demand(page):
    view = page.locator("#view")
    pictures = [view.screenshot()]
    for label in ("Trails", "Rays, grey where they miss", "Targets of ankles (pink)"):
        with page.expect_response("**/solve") if label != "Trails" else contextlib.nullcontext():
            page.get_by_label(label).click()
        ankles(page)
        pictures.append(view.screenshot())
        page.get_by_label(label).click()
    assert len(set(pictures)) == 4


def test_the_worst_moments_curves_and_figures_follow_what_is_watched(page):
    rows = page.locator("#figures tbody tr")
    assert rows.count() == 3 and rows.nth(1).inner_text().startswith("solved")
    moment = page.locator("#moments button").first
    seconds = moment.inner_text().rpartition(", ")[2].removesuffix(" s")
    moment.click()
    assert page.locator("#clock").inner_text().startswith(f"{float(seconds):.2f} /")
    assert "Soles over the ground: left" in (page.locator("#curves").text_content() or "")
    words = page.locator("#moments").inner_text()
    page.locator("#watched").select_option("animated")
    assert page.locator("#moments").inner_text() != words
    page.locator("#watched").select_option("solved")


def test_save_writes_what_is_shown(page, run):
    page.get_by_role("button", name="Save parameters and record").click()
    page.get_by_text("Parameters are in").wait_for()
    assert (run / "tuned.toml").exists()
    assert (run / "tuned.bin").exists() or page.get_by_text("No record is written").is_visible()


def test_a_stance_is_dragged_split_and_left_out_and_its_clip_is_read_so(page, run):
    contact = page.locator("#timeline .contact").first
    words = contact.get_attribute("aria-label")
    bar = contact.locator(".bar").bounding_box()
    x, y = bar["x"] + bar["width"] - 2, bar["y"] + bar["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for part in (0.2, 0.4):
        page.mouse.move(x - part * bar["width"], y)
    page.mouse.up()
    moved = page.locator("#timeline .contact").first.get_attribute("aria-label")
    assert moved != words and "set by hand" in moved
    end = float(page.locator("#contact-end").input_value())
    page.keyboard.press("ArrowLeft")
    assert float(page.locator("#contact-end").input_value()) == pytest.approx(
        end - 1 / 30, abs=2e-3
    )
    page.keyboard.press("x")
    assert page.get_by_label("Leave out of the fit").is_checked()
    count = page.locator("#timeline .contact").count()
    page.keyboard.press("Delete")
    assert page.locator("#timeline .contact").count() == count - 1
    page.locator("#contact-undo").click()
    page.locator("#contact-save").click()
    page.get_by_text("left out of the fit.").first.wait_for()
    file = (run / "uneven_walk.contacts.toml").read_text()
    assert "left_out = true" in file
    left = load_clip(run / "uneven_walk.npz")
    assert left.left_out is not None and left.left_out[30:46].any()
