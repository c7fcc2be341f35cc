"""Pages in a browser: they open from disk, draw, play, and fit a phone."""

import base64
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxik
from fitting.motion import accuracy, measures, playback
from fitting.report import motion_data, pages
from fitting.studies import comparison
from fitting.studies.fit import fit_motions
from fitting.studies.fit.fit import Fit
from fitting.studies.sample import sample_jobs
from fitting.studies.sample.sample_jobs import ComparedRun
from jaxik.maths import parameter_tree
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
OWN = ("data:", "blob:")  # what a page has made by itself
PHONE = {"width": 390, "height": 844}
DESKTOP = {"width": 1280, "height": 900}

playwright = pytest.importorskip(
    "playwright.sync_api", reason='needs `pip install "jaxik[browser]"`'
)
pytestmark = needs_chromium


@pytest.fixture(scope="module")
def fitted(tmp_path_factory) -> Fit:
    return runs.with_clips(runs.invented_fit(tmp_path_factory.mktemp("run")))


@pytest.fixture(scope="module")
def path(fitted) -> Path:
    folder = fitted.experiment.path.parent
    runs.write_run(folder, fitted)
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
    sample_jobs.document(RUNS).write(folder)
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
    own = [event for event in events if event not in loaded and not event.startswith(OWN)]
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
    assert shown(page)["shown"] == "before"
    for button in page.locator("[data-view]").all():
        button.click()
        shown(page)
        pictures.append(view.screenshot())
    assert len({bytes(picture) for picture in pictures}) >= len(pictures) - 1  # corner is the first


def test_all_limbs_throw_a_shadow_however_many_there_are(open_page, path, tmp_path):
    data = Page(path).data
    limbs = data["clips"][0]["skeletons"][-1]["shape"]["limbs"]
    limbs[:0] = 70 * limbs[:1]
    crowded = tmp_path / "crowded.html"
    whole = path.read_text()
    start = whole.index(">", whole.index('id="data"')) + 1
    end = whole.index("</script>", start)
    crowded.write_text(whole[:start] + str(pages.as_json(data)) + whole[end:])
    pictures = []
    for shown_path in (path, crowded):
        page = open_page(path=shown_path)
        page.locator("#legend input").first.click()  # what is behind it would be drawn 70 times
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


def test_the_table_beside_the_view_has_the_figures_of_the_report(open_page, fitted):
    page = open_page()
    cells = page.locator("#figures tbody td").all_inner_texts()
    assert not [cell for cell in cells if cell.startswith("-") and float(cell) == 0]
    row = page.locator("#figures tbody tr", has_text="fitted")
    shown = [float(cell) for cell in row.locator("td").all_inner_texts()]
    (clip,), (result,) = fitted.clips, fitted.results
    motions = fit_motions.clip_motions(clip, result, result)
    close, placed = accuracy.summarise([motions.errors["fitted"]]), motions.fitted.measures
    distances = [close.ankle, close.ankle_stance, close.knee, close.pelvis, placed.slide]
    expected = [100 * distance for distance in distances]
    assert shown[:4] + shown[5:] == pytest.approx(expected, abs=0.011)
    assert shown[4] == pytest.approx(100 * placed.penetration, abs=0.051)


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
    assert page.get_by_role("heading", name="Parameters", exact=True).is_visible()
    assert page.locator("#live").is_hidden()
    page.close()


# Live parameters


SOLVED = """(() => {
  const solution = document.getElementById("live").solution;
  if (!solution || !solution.parameters.includes(VALUE)) return null;
  const names = ["points", "parameters", "gap"];
  return Object.fromEntries(names.map((name) => [name, Array.from(solution[name])]));
})()"""


def solution(page: Any, value: float) -> dict[str, list[float]]:
    """What the page has solved with parameters among which there is this value."""
    solved = SOLVED.replace("VALUE", repr(value))
    page.wait_for_function(solved)
    return page.evaluate(solved)


def stored_gap(skeleton: dict[str, Any]) -> np.ndarray:
    """Heights of the soles over the ground as a page has them, m."""
    steps = np.frombuffer(base64.b64decode(skeleton["gap"]), "<i2")
    return np.where(steps == motion_data.NO_GAP, np.nan, motion_data.TENTH * steps)


def shown_by_jaxik(fitted: Fit, data: dict[str, Any], ik: jaxik.FootIK) -> np.ndarray:
    """Joints and soles of a system's motion, relative to the corner of the page, m."""
    (clip,), (scene,) = fitted.clips, fitted.scenes
    solved = fit_motions.fitted_clip(clip, playback.run(ik, scene))
    captured = data["skeletons"][2]
    start = np.frombuffer(base64.b64decode(captured["root"]), "<f4")[:3]
    corner = clip.reference.positions_ws[0, captured["pelvis"]] - start
    soles = measures.sole_points(solved).reshape(len(solved.positions_ws), -1, 3)
    return np.concatenate([solved.positions_ws, soles], axis=1) - corner


def test_the_page_solves_a_clip_as_jaxik_run_does(open_page, fitted, path):
    page, (data,) = open_page(), Page(path).data["clips"]
    assert page.locator("#live-status").is_hidden()
    page.locator("#live > summary").click()
    unchanged = solution(page, float(fitted.ik.foot.max_pitch))
    frames, skeleton = data["frames"], data["skeletons"][3]
    ours = np.reshape(unchanged["points"], (frames, -1, 3))
    np.testing.assert_allclose(ours, shown_by_jaxik(fitted, data, fitted.ik), atol=1e-4)
    np.testing.assert_allclose(np.asarray(unchanged["gap"], float), stored_gap(skeleton), atol=2e-4)
    before, sliders = shown(page)["ankles"], page.locator("#live-sliders")
    sliders.get_by_label("foot.max_pitch", exact=True).fill("0.3")
    sliders.get_by_text("leg", exact=True).click()
    sliders.get_by_label("leg.weight", exact=True).fill("0.61")
    changed = solution(page, 0.61)
    moved = {"foot.max_pitch": 0.3, "leg.weight": 0.61}
    expected = shown_by_jaxik(fitted, data, parameter_tree.replace(fitted.ik, moved))
    assert np.abs(expected - ours).max() > 0.01
    ours = np.reshape(changed["points"], (frames, -1, 3))
    np.testing.assert_allclose(ours, expected, atol=1e-4)
    assert page.locator("#legend").inner_text().endswith("fitted, live")
    assert shown(page)["ankles"] != before
    status = page.locator("#live-status").inner_text()
    print(status)  # with the time that it took
    assert re.fullmatch(
        r"Live: “fitted” solved in \d+ ms\. "
        r"Ankles \d+\.\d\d cm from captured \(rms\); as fitted \d+\.\d\d cm\.", status
    )  # fmt: skip
    for slider in sliders.locator("input[type=range]").all():
        if "∞" in (slider.get_attribute("aria-valuetext") or ""):
            assert float(slider.input_value()) > 0.99 * float(slider.get_attribute("max"))
    changes = page.locator("#live-changes").inner_text()
    assert changes == "foot.max_pitch = 0.3\nleg.weight = 0.61"
    page.get_by_role("button", name="fitted", exact=True).click()
    page.wait_for_function("!document.getElementById('legend').textContent.includes('live')")
    assert shown(page)["ankles"] == before and page.locator("#live-changes").is_hidden()


@pytest.mark.slow
def test_a_comparison_solves_the_clip_with_the_system_that_is_watched(open_page, tmp_path):
    systems = comparison.named_systems([("--presets", "record,stride,mec,unreal")])
    compared = comparison.run_systems(systems, comparisons.walk(1.5))
    comparison.document(compared).write(tmp_path)
    page, (data,) = open_page(path=tmp_path / pages.PAGE), Page(tmp_path / pages.PAGE).data["clips"]
    page.locator("#live > summary").click()
    for name in systems:
        page.evaluate("document.getElementById('live').solution = null")
        page.locator("#watched").select_option(f"motion {name}")
        page.wait_for_function("document.getElementById('live-status').textContent.includes('cm')")
        assert page.locator("#live-system").input_value() == f"motion {name}"
        solved = solution(page, 1.0)
        (skeleton,) = [each for each in data["skeletons"] if each["key"] == f"motion {name}"]
        root = np.frombuffer(base64.b64decode(skeleton["root"]), "<f4").reshape(-1, 1, 3)
        offsets = np.frombuffer(base64.b64decode(skeleton["offsets"]), "<i2")
        stored = root + skeleton["quantum"] * offsets.reshape(data["frames"], -1, 3)
        ours = np.reshape(solved["points"], stored.shape)
        np.testing.assert_allclose(ours, stored, atol=1e-4, err_msg=name)
        gap = np.asarray(solved["gap"], float)
        np.testing.assert_allclose(gap, stored_gap(skeleton), atol=2e-4, err_msg=name)


def test_parameters_are_changed_by_keyboard_on_a_phone(open_page):
    page = open_page(PHONE, color_scheme="dark")
    page.locator("#live > summary").focus()
    page.keyboard.press("Enter")
    slider = page.locator("#live-sliders").get_by_label("foot.max_pitch", exact=True)
    slider.focus()
    value = float(slider.input_value())
    page.keyboard.press("ArrowRight")
    assert float(slider.input_value()) > value
    assert slider.get_attribute("aria-valuetext").endswith(" rad")
    page.wait_for_function("document.getElementById('legend').textContent.includes('live')")
    assert page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
    assert page.locator("#view").is_visible()
