"""Pages in a browser: they open from disk, draw, play, and fit a phone."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fitting.report import pages
from fitting.studies import comparison
from fitting.studies.sample import run_comparison
from fitting.studies.sample.run_comparison import ComparedRun
from support import comparisons, runs
from support.browsers import launch, needs_chromium
from support.pages import Page

STILL = """(() => {
  const still = document.getElementById("still");
  const pixels = still.getContext("2d").getImageData(0, 0, still.width, still.height).data;
  return Array.from(pixels.filter((_, i) => i % 1237 === 0));
})()"""
RUNS = [
    ComparedRun("a", -10.0, 2.0, 0.0, 0.0, 3.0, 0, {1: -10.0}),
    ComparedRun("b", -15.0, 2.0, 5.0, 1.0, 4.0, 2, {1: -15.0}),
]
PHONE = {"width": 390, "height": 844}
DESKTOP = {"width": 1280, "height": 900}

playwright = pytest.importorskip(
    "playwright.sync_api", reason='needs `pip install "jaxik[browser]"`'
)
pytestmark = needs_chromium


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    runs.write_run(folder, runs.with_clips(runs.invented_fit(folder)))
    return folder / pages.PAGE


@pytest.fixture(scope="module")
def comparison_path(tmp_path_factory) -> Path:
    """The page of two systems that are 10 cm apart, the lower one watched."""
    folder = tmp_path_factory.mktemp("compared")
    compared = comparisons.invented_comparison(comparisons.walk())
    comparison.document(compared).write(folder)
    return folder / pages.PAGE


@pytest.fixture(scope="module")
def plain_path(tmp_path_factory) -> Path:
    """A page without a view."""
    folder = tmp_path_factory.mktemp("plain")
    run_comparison.document(RUNS).write(folder)
    return folder / pages.PAGE


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        browser = launch(driver)
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser, path) -> Iterator[Callable[..., Any]]:
    """Opens a page from disk; at the end, nothing has gone wrong and nothing was loaded."""
    contexts, events, opened_pages = [], [], [path]

    def opened(
        viewport: dict[str, int] = DESKTOP, path: Path = path, view: bool = True, **settings: Any
    ) -> Any:
        opened_pages.append(path)
        context = browser.new_context(viewport=viewport, offline=True, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: events.append(message.text))
        page.on("pageerror", lambda error: events.append(str(error)))
        page.on("request", lambda request: events.append(request.url))
        page.goto(path.as_uri())
        if view:
            page.wait_for_function("document.getElementById('view').dataset.ankles")
        return page

    yield opened
    for context in contexts:
        context.close()
    loaded = {page.as_uri() for page in opened_pages}
    own = [event for event in events if event not in loaded and not event.startswith("data:")]
    assert own == []


def shown(page: Any) -> dict[str, str]:
    """What the view shows, after the next frame that it draws."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.evaluate("({...document.getElementById('view').dataset})")


def test_the_slider_moves_the_feet(open_page):
    page = open_page()
    before = shown(page)
    page.locator("#time").fill("4")
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


def test_all_bones_throw_a_shadow_however_many_there_are(open_page, path, tmp_path):
    data = Page(path).data
    bones = data["clips"][0]["skeletons"][-1]["bones"]
    bones[:0] = 70 * bones[:1]
    crowded = tmp_path / "crowded.html"
    whole = path.read_text()
    start = whole.index(">", whole.index('id="data"')) + 1
    end = whole.index("</script>", start)
    crowded.write_text(whole[:start] + str(pages.as_json(data)) + whole[end:])
    pictures = []
    for shown_path in (path, crowded):
        page = open_page(path=shown_path)
        shown(page)
        pictures.append(page.locator("#view").screenshot())
    assert pictures[0] == pictures[1]


def test_it_plays_by_keyboard_and_stops_at_the_end(open_page):
    page = open_page()
    page.locator("#play").focus()
    page.keyboard.press("Enter")
    assert page.locator("#play").get_attribute("aria-label") == "Pause"
    page.wait_for_function("document.getElementById('view').dataset.playing === 'false'")
    last = page.locator("#time").get_attribute("max")
    # The picture of the last frame may come a moment after the end.
    page.wait_for_function(f"document.getElementById('view').dataset.frame === '{last}'")
    assert int(last) > 0
    page.locator("#time").focus()
    page.keyboard.press("ArrowLeft")
    assert shown(page)["frame"] == str(int(last) - 1)


def test_the_worst_seconds_are_one_click_away(open_page):
    page = open_page()
    page.locator("#time").fill("3")
    page.locator(".to-worst").click()
    page.wait_for_function("document.getElementById('view').dataset.playing === 'false'")
    assert page.locator("#motion").is_visible()


def test_a_phone_needs_no_sideways_scrolling(open_page, path, comparison_path):
    for shown_path in (path, comparison_path):
        page = open_page(PHONE, path=shown_path)
        assert page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
        if shown_path == comparison_path:  # its picture has a frame of its own
            assert page.locator("figure img").bounding_box()["width"] > PHONE["width"]


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


def test_the_slider_of_a_comparison_moves_the_feet_of_the_system_that_is_watched(
    open_page, comparison_path
):
    page = open_page(path=comparison_path)
    before = shown(page)
    page.locator("#time").fill("4")
    after = shown(page)
    assert (before["frame"], after["frame"]) == ("0", "4") and before["ankles"] != after["ankles"]
    assert after["watched"] == "motion deep" and page.locator("#alert").is_visible()
    assert after["shown"] == "motion close captured motion deep"
    heights = [ankle_heights(after)]
    page.locator("#watched").select_option("motion close")
    heights.append(ankle_heights(shown(page)))
    apart = [high - low for low, high in zip(*heights, strict=True)]
    assert apart == pytest.approx([comparisons.DEEP] * 2, abs=2e-4)
    assert page.locator("#alert").is_hidden()
    page.locator(".to-worst").nth(1).click()
    assert shown(page)["watched"] == "motion deep"


def ankle_heights(view: dict[str, str]) -> list[float]:
    return [float(ankle.split(",")[1]) for ankle in view["ankles"].split()]


def test_a_page_without_a_view_is_read_in_both_themes(open_page, plain_path):
    page = open_page(PHONE, path=plain_path, view=False, color_scheme="dark")
    assert page.locator(".findings li").count() == 3
    assert page.evaluate("document.documentElement.dataset.theme") == "dark"
    page.locator("#theme").click()
    assert page.evaluate("document.documentElement.dataset.theme") == "light"
    assert page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]


def test_without_webgl_the_rest_can_be_read(browser, path):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(path.as_uri())
    assert page.locator("#failure").is_visible()
    assert page.locator("#parameters-heading").is_visible()
    page.close()
