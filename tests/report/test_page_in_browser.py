"""The page of a fit in a browser: it opens from disk, draws, plays, and fits a phone."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fitting.studies import run_folder
from support import runs

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOFTWARE_GL = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
STILL = """(() => {
  const still = document.getElementById("still");
  const pixels = still.getContext("2d").getImageData(0, 0, still.width, still.height).data;
  return Array.from(pixels.filter((_, i) => i % 1237 === 0));
})()"""
PHONE = {"width": 390, "height": 844}
DESKTOP = {"width": 1280, "height": 900}

playwright = pytest.importorskip(
    "playwright.sync_api", reason='needs `pip install "jaxik[browser]"`'
)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium, which is not installed")


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    runs.write_run(folder, runs.with_clips(runs.invented_fit(folder)))
    return folder / run_folder.PAGE


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", *SOFTWARE_GL]
        )
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser, path) -> Iterator[Callable[..., Any]]:
    """Opens the page from disk; at the end, nothing has gone wrong and nothing was loaded."""
    contexts, events = [], []

    def opened(viewport: dict[str, int] = DESKTOP, **settings: Any) -> Any:
        context = browser.new_context(viewport=viewport, offline=True, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: events.append(message.text))
        page.on("pageerror", lambda error: events.append(str(error)))
        page.on("request", lambda request: events.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_function("document.getElementById('view').dataset.ankles")
        return page

    yield opened
    for context in contexts:
        context.close()
    assert [event for event in events if event not in (path.as_uri(), "data:,")] == []


def shown(page: Any) -> dict[str, str]:
    """What the view shows, after the next frame that it draws."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.evaluate("({...document.getElementById('view').dataset})")


def drag_to(page: Any, frame: int) -> None:
    page.locator("#time").fill(str(frame))


def test_the_slider_moves_the_feet(open_page):
    page = open_page()
    before = shown(page)
    drag_to(page, 4)
    after = shown(page)
    assert (before["frame"], after["frame"]) == ("0", "4")
    assert before["ankles"] != after["ankles"]
    assert "0.13 /" in page.locator("#clock").inner_text()


def test_the_view_is_drawn_and_changes_with_the_legend_and_the_camera(open_page):
    page = open_page()
    view = page.locator("#view")
    pictures = [view.screenshot()]
    for box in page.locator("#legend input").all():
        box.click()
        shown(page)
        pictures.append(view.screenshot())
    assert shown(page)["shown"] == "animated before"
    for button in page.locator("[data-view]").all():
        button.click()
        shown(page)
        pictures.append(view.screenshot())
    assert len({bytes(picture) for picture in pictures}) >= len(pictures) - 1  # corner is the first


def test_it_plays_by_keyboard_and_stops_at_the_end(open_page):
    page = open_page()
    page.locator("#play").focus()
    page.keyboard.press("Enter")
    assert page.locator("#play").get_attribute("aria-label") == "Pause"
    page.wait_for_function("document.getElementById('view').dataset.playing === 'false'")
    last = page.locator("#time").get_attribute("max")
    assert shown(page)["frame"] == last and int(last) > 0
    page.locator("#time").focus()
    page.keyboard.press("ArrowLeft")
    assert shown(page)["frame"] == str(int(last) - 1)


def test_the_worst_seconds_are_one_click_away(open_page):
    page = open_page()
    drag_to(page, 3)
    page.locator(".to-worst").click()
    page.wait_for_function("document.getElementById('view').dataset.playing === 'false'")
    assert page.locator("#motion").is_visible()


def test_a_phone_needs_no_sideways_scrolling(open_page):
    page = open_page(PHONE)
    assert page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]


def test_it_is_dark_where_the_system_is_and_the_button_changes_that(open_page):
    page = open_page(color_scheme="dark")
    background = "getComputedStyle(document.body).backgroundColor"
    dark = page.evaluate(background)
    page.locator("#theme").click()
    light = page.evaluate(background)
    assert sum(map(int, dark[4:-1].split(","))) < 200 < sum(map(int, light[4:-1].split(",")))
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    pixels = page.evaluate(STILL)
    assert len(set(pixels)) > 20 and sum(pixels) > 120 * len(pixels)  # a picture, and light


def test_without_webgl_the_rest_can_be_read(browser, path):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(path.as_uri())
    assert page.locator("#failure").is_visible()
    assert page.locator("#parameters-heading").is_visible()
    page.close()
