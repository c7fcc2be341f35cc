"""What pages solve again by themselves: their rays, and clips that cannot be solved there."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.report import live_data
from fitting.report.live_data import LiveClip, LiveSystem
from fitting.report.sliders import sliders
from jaxik.world import terrain
from support import comparisons, node
from support.node import needs_node

CORNER = np.array([-3.0, -1.0, 2.0])
CAST = """
const { surfaces, rays } = JSON.parse(require("node:fs").readFileSync("rays.json", "utf8"));
const zlib = require("node:zlib");
const system = { RAY_SIZE: 8, HIT_SIZE: 7 };
const array = (Type, text) => {
  const bytes = zlib.inflateSync(Buffer.from(text, "base64"));
  return new Type(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
};
SOLVER
const table = (text, columns) => { // column by column, without the last two bytes of each number
  const planes = array(Uint8Array, text), count = planes.length / 6, rows = count / columns;
  const bytes = new Uint8Array(8 * count);
  planes.forEach((byte, i) => {
    const place = i % count;
    const number = (place % rows) * columns + Math.floor(place / rows);
    bytes[8 * number + 2 + Math.floor(i / count)] = byte;
  });
  return new Float64Array(bytes.buffer);
};
for (const surface of surfaces) {
  if (surface.kind === "Heights") surface.heights = table(surface.heights, surface.columns);
  if (surface.kind !== "Mesh") continue;
  surface.vertices = table(surface.vertices, 3);
  surface.triangles = array(Uint32Array, surface.triangles);
  surface.layers = array(Uint32Array, surface.layers);
}
const ground = new Ground(surfaces);
const hits = new Float64Array(7 * rays.length / 8);
for (let ray = 0; ray < rays.length / 8; ray++) ground.cast(rays, hits, ray);
console.log(JSON.stringify(Array.from(hits)));
"""


@pytest.fixture(scope="module")
def live() -> LiveClip:
    """A short walk without systems, on no ground yet."""
    animation = comparisons.walk(0.1)
    clip = animation.clip
    return LiveClip(clip, animation.frames, clip.rig, animation.terrain, clip.observed, systems={})


def overhanging(middle: np.ndarray) -> terrain.Terrain:
    """Random triangles above each other, some of which are walls, with gaps, on two layers."""
    random = np.random.default_rng(5)
    corners = random.uniform(-1.0, 1.0, (400, 1, 3)) + random.uniform(-0.4, 0.4, (400, 3, 3))
    corners[:40, :, 0] = corners[:40, :1, 0]
    vertices = corners.reshape(-1, 3) + middle
    layers = random.integers(0, 2, 400)
    return terrain.mesh(vertices, np.arange(1200).reshape(-1, 3), layer=layers)


def grounds(middle: np.ndarray) -> dict[str, terrain.Terrain]:
    heights = np.random.default_rng(6).normal(0.0, 0.1, (60, 50))
    heights[20:24, 20:30] = np.nan
    spacing = (0.05, 0.04)
    origin = middle - [1.2, 0.0, 1.2]
    plane = terrain.plane(middle - [0.0, 0.3, 0.0], (0.2, 1.0, -0.1))
    return {
        "bilinear": terrain.heightfield(heights, spacing, origin),
        "triangulated": terrain.heightfield(heights, spacing, origin, interpolation="triangulated"),
        "several": terrain.combine(plane, overhanging(middle), terrain.plane(middle - 0.2)),
    }


@needs_node
@pytest.mark.parametrize("name", ["bilinear", "triangulated", "several"])
def test_rays_of_a_page_hit_what_those_of_jaxik_hit(name, live, tmp_path):
    random, count = np.random.default_rng(7), 2000
    middle = live.animated.positions_ws[:, live.animated.rig.pelvis].mean(axis=0)
    ground = grounds(middle)[name]
    origins = middle + random.uniform(-1.3, 1.3, (count, 3))
    reach = random.uniform(0.1, 2.5, count)
    mask = random.choice([1, 2, 3, terrain.ALL_LAYERS], count).astype(np.uint32)
    rays = jnp.asarray(origins, np.float32), jnp.asarray(reach, np.float32), jnp.asarray(mask)
    expected = terrain.cast(ground, *rays)
    system_rays = np.column_stack([
        np.float32(origins) - CORNER, np.tile([0.0, -1.0, 0.0], (count, 1)), reach, mask,
    ])  # fmt: skip
    placed = dataclasses.replace(live, terrain=ground)
    surfaces = [live_data.pack_surface(each, placed, CORNER) for each in ground.surfaces]
    content = {"surfaces": surfaces, "rays": system_rays.ravel().tolist()}
    (tmp_path / "rays.json").write_text(json.dumps(content))
    (tmp_path / "cast.cjs").write_text(CAST.replace("SOLVER", live_data.solver()))
    done = node.run(tmp_path, "cast.cjs")
    assert done.returncode == 0, done.stderr
    hits = np.reshape(json.loads(done.stdout), (count, 7))
    is_hit = np.asarray(expected.found) > 0
    assert 0.2 < is_hit.mean() < 0.98
    same = (hits[:, 6] > 0) == is_hit
    assert same.mean() > 0.999  # but for rounding at an edge
    both = is_hit & same
    np.testing.assert_allclose(hits[both, :3] + CORNER, np.asarray(expected.point)[both], atol=2e-5)
    near = np.abs(hits[both, 3:6] - np.asarray(expected.normal)[both]).max(axis=1) < 1e-3
    assert near.mean() > 0.998


def test_what_cannot_be_solved_on_a_page_is_said_in_a_line(live, monkeypatch):
    ik = jaxik.presets.unreal()
    systems = {"motion": LiveSystem({"compared": ik}, sliders(ik))}
    live = dataclasses.replace(live, systems=systems)
    tilted = terrain.plane(up=(0.0, 1.0, 0.2))
    moving = terrain.moving(terrain.plane(), 0)
    waves = terrain.function(lambda x, z: 0.1 * x)
    cases = {
        "a track changes parameters along the clip": {"has_tracks": True},
        "its ground moves": {"terrain": moving},
        "up is not the y axis": {"terrain": tilted},
        "its ground is neither a mesh, nor a plane, nor a grid of heights": {"terrain": waves},
    }
    clips = [dataclasses.replace(live, **changes) for changes in cases.values()]
    contents, size = live_data.pack(clips, [CORNER] * len(clips))
    assert contents == [{"reason": reason} for reason in cases] and size == 0
    monkeypatch.setattr(live_data, "MAX_TRIANGLES", 1)
    ((content,), _) = live_data.pack([live], [CORNER])
    assert content and "the ground near its path has" in content["reason"]
    monkeypatch.setattr(live_data, "_pack", lambda *_: {"scripts": {}, "numbers": "A" * 1000})
    monkeypatch.setattr(live_data, "MAX_BYTES", 700)
    assert live_data.pack([live], [CORNER])[0] == [{"reason": "the page would become too large"}]
    assert live_data.pack([None, dataclasses.replace(live, systems={})], [CORNER] * 2) == (
        [None, None],
        0,
    )
