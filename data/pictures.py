"""Makes the moving picture of the README from a run: `python data/pictures.py runs/blocks_walk`.

The run is that of `jaxik fit data/experiments/blocks_walk.toml -o runs/blocks_walk`, which has legs
alone: what else moves is the captured walk's, carried by the pelvis. Our own page draws all of it
in headless Chromium: to the left the flat animation, which goes through the blocks, to the right
what the fit makes of it, within the captured walk as glass.
"""

import argparse
import io
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from fitting.clips import Clip, edit, load_clip
from fitting.clips.assemble import JointMotion, clip_from_joints
from fitting.ground import ground_path, meshes
from fitting.motion import measures
from fitting.report import motion_data, pages
from fitting.report.document import Document, View
from fitting.report.motion_data import ViewedClip, ViewedMotion
from fitting.runtime.precision import in_float64

HERE = Path(__file__).resolve().parent
CAPTURE = HERE.parents[1] / "shared" / "mocap"
WALK, BLOCKS = CAPTURE / "clips/cmu_asfamc/03_03.amc", CAPTURE / "blocks/terrain.ply"
PICTURE = HERE / "pictures" / "walk.webp"
START, SECONDS, RATE = 33.4, 4.0, 15.0  # s, s and Hz, of the picture
PANEL, GAP = (478, 500), 4  # pixels, of each half and between them
CLOSER, TURNED = 3, 2  # presses of the keys
QUALITY = 80
LEGS = ("pelvis", "left_hip", "left_knee", "left_ankle", "left_toe",
        "right_hip", "right_knee", "right_ankle", "right_toe")  # fmt: skip
BELOW = ("hipjoint", "femur", "tibia", "foot", "toes")  # in names of an ASF
INK = "#1b2226"
CHROMIUM = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader")  # fmt: skip
DRAWN = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def whole(legs: Clip, captured: Clip) -> Clip:
    """Legs with the upper body of a captured clip above their pelvis."""
    upper = [
        joint
        for joint, name in enumerate(captured.joint_names)
        if joint and not any(part in name for part in BELOW)
    ]
    below = {0: 0} | {joint: len(LEGS) + index for index, joint in enumerate(upper)}
    order = [legs.joint_names.index(name) for name in LEGS]
    parents = [-1, 0, 1, 2, 3, 0, 5, 6, 7] + [below[captured.parents[joint]] for joint in upper]
    carried = legs.positions_ws[:, order[:1]] - captured.positions_ws[:, :1]
    motion = JointMotion(
        (*LEGS, *(captured.joint_names[joint] for joint in upper)),
        tuple(parents),
        np.concatenate([legs.positions_ws[:, order], captured.positions_ws[:, upper] + carried], 1),
        np.concatenate([legs.rotations_ws[:, order], captured.rotations_ws[:, upper]], 1),
        legs.stance_labels(),
        legs.fps,
    )
    return clip_from_joints(motion, legs.source)


def viewed(run: Path) -> ViewedClip:
    """Flat animation, captured and fitted motion of the part that is shown."""
    terrain = meshes.load_terrain(BLOCKS)
    names = "base.npz", "fitted.npz"
    flat, fitted = (edit.trim(load_clip(run / name), START, START + SECONDS) for name in names)
    captured = edit.resample(load_clip(WALK), flat.fps)
    captured = edit.trim(captured, START, START + SECONDS)
    flat, fitted = whole(flat, captured), whole(fitted, captured)
    places = [measures.place(clip, flat, flat, terrain) for clip in (flat, captured, fitted)]
    animated = motion_data.ANIMATED._replace(thickness=1.0, opacity=1.0)
    motions = {
        "animated": ViewedMotion("flat animation", places[0], animated, True),
        "captured": ViewedMotion("as captured", places[1], motion_data.CAPTURED, True),
        "fitted": ViewedMotion("with foot IK, fitted", places[2], motion_data.FITTED, True),
    }
    ground = ground_path.around_path(fitted, terrain)
    return ViewedClip(motions, fitted.stance_labels(), flat=flat, ground=ground, watched="fitted")


def page(clip: ViewedClip, folder: Path) -> Path:
    """A page of a report that shows nothing but a clip."""
    Document(
        file="walk.txt", kind="", title="walk", verdict="", good=True, findings=(), sections=(),
        setup=[], view=View([clip], ["walk"], "2 cm"),
    ).write(folder)  # fmt: skip
    return folder / pages.PAGE


def frames(path: Path) -> Iterator[Image.Image]:
    """The picture, frame by frame, both halves side by side."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(CHROMIUM))
        halves = [half(browser, path, shown) for shown in (("animated",), ("captured", "fitted"))]
        rate = float(
            halves[0].evaluate(
                "JSON.parse(document.getElementById('data').textContent).clips[0].rate"
            )
        )
        words = "flat animation", "after foot IK, and the capture as glass"
        for number in range(round(SECONDS * RATE)):
            picture = Image.new("RGB", (2 * PANEL[0] + GAP, PANEL[1]), "white")
            for column, (opened, label) in enumerate(zip(halves, words, strict=True)):
                opened.locator("#time").fill(str(round(number * rate / RATE)))
                opened.evaluate(DRAWN)
                content = opened.locator("#view").screenshot()
                drawn = Image.open(io.BytesIO(content)).convert("RGB").resize(PANEL)
                write(drawn, label)
                picture.paste(drawn, (column * (PANEL[0] + GAP), 0))
            yield picture
        browser.close()


def half(browser: Any, path: Path, shown: tuple[str, ...]) -> Any:
    """A page that shows some of the motions."""
    opened = browser.new_page(viewport={"width": 1000, "height": 900}, color_scheme="light")
    opened.goto(path.as_uri())
    size = f"#view {{ width: {PANEL[0]}px; height: {PANEL[1]}px }}"
    opened.add_style_tag(content=f"{size} .legend, .alert {{ display: none }}")
    opened.wait_for_function("document.getElementById('view').dataset.ankles")
    opened.locator("#watched").select_option(shown[-1])
    for box in opened.locator("#legend input").all():
        box.evaluate(
            f"box => box.checked !== {list(shown)}.includes(box.dataset.key) && box.click()"
        )
    opened.locator("#trails").uncheck()
    opened.locator("#view").focus()
    for key, times in (("+", CLOSER), ("ArrowLeft", TURNED)):
        for _ in range(times):
            opened.keyboard.press(key)
    return opened


def write(picture: Image.Image, label: str) -> None:
    """Writes a label at the top of a picture."""
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 21)
    ImageDraw.Draw(picture).text((14, 10), label, INK, font)


@in_float64
def make(run: Path, picture: Path) -> None:
    """Writes the moving picture of a run."""
    with tempfile.TemporaryDirectory() as folder:
        first, *others = frames(page(viewed(run), Path(folder)))
    first.save(
        picture, save_all=True, append_images=others, duration=round(1000 / RATE), loop=0,
        quality=QUALITY, method=4,
    )  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Makes the moving picture of the README.")
    parser.add_argument("run", type=Path, help="folder of the fit of blocks_walk.toml")
    parser.add_argument("-o", "--output", type=Path, default=PICTURE, help="WebP to write")
    given = parser.parse_args()
    make(given.run, given.output)
