"""Long clips: computed in bounded memory, and accurate in single precision."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxik
from fitting.datasets.clip_frames import frames_from_clip
from fitting.datasets.synthetic import walker
from jaxik import presets
from jaxik.world import terrain
from support.cases import QUICK

pytestmark = pytest.mark.slow

FPS = 60.0
PLACE = 1e-4  # m, tolerated error of single precision


@functools.cache
def walk() -> tuple[jaxik.Rig, jaxik.Frame]:
    clip = walker.walk(3.0, FPS, seed=4)
    return clip.rig, frames_from_clip(clip)


def repeated(count: int) -> jaxik.Frame:
    """The walk repeated to `count` frames; it jumps at each repetition."""
    return jax.tree.map(lambda leaf: leaf[jnp.arange(count) % leaf.shape[0]], walk()[1])


def summed(height: jax.Array, frames: jaxik.Frame, block: int | None = None) -> jax.Array:
    """Of a clip on a slope that begins at a height, a number with a derivative."""
    slope = terrain.plane(point=jnp.stack([0.0, height, 0.0]), normal=(0.1, 1.0, 0.05))
    result = jaxik.run(presets.mec(faithful=True), walk()[0], slope, frames, block=block)
    return jnp.sum(result.pose.knee.pos**2)


def test_reverse_mode_works_through_blocks_and_keeps_one_in_memory():
    short, long = (
        jax.jit(lambda height, frames: jax.grad(summed)(height, frames, 32))
        .lower(0.02, repeated(count))
        .compile(QUICK)
        for count in (128, 1024)
    )
    beside = jax.jit(summed)
    above, below = (beside(0.02 + step, repeated(128)) for step in (1e-6, -1e-6))
    slope = short(0.02, repeated(128))
    assert abs(slope) > 0.1
    np.testing.assert_allclose(slope, (above - below) / 2e-6, rtol=1e-6)
    small, large = (one.memory_analysis().temp_size_in_bytes for one in (short, long))
    assert large < 2 * small


def test_a_hundred_thousand_frames_in_single_precision_stay_accurate():
    count = 100_000
    ground = terrain.plane(normal=(0.1, 1.0, 0.05))
    given = (presets.record(), walk()[0], ground, repeated(count))
    wide = jaxik.run(*given, block=5000)
    narrow = jaxik.run(*jax.tree.map(_single, given), block=5000)
    for name in ("hip", "knee", "ankle", "toe"):
        places, rough = (np.asarray(getattr(one.pose, name).pos) for one in (wide, narrow))
        assert rough.dtype == np.float32
        assert np.linalg.norm(rough - places, axis=-1).max() < PLACE
    lifted = np.asarray(wide.body.pos) - np.asarray(narrow.body.pos)
    assert np.linalg.norm(lifted, axis=-1).max() < PLACE


def _single(leaf: jax.Array) -> jax.Array:
    return leaf.astype(jnp.float32) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf
