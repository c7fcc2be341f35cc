"""Animation curves of glTF: keys, and the values between them at any time."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from .document import Document, Item

WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
ON_KEY = 1e-5  # s; times that are given with 32 bits are no more exact
LATEST = 1e6  # s
USUAL_RATE = 30.0  # Hz, of animations whose keys follow no rate
RATES = (8.0, 1000.0)  # Hz; keys outside are no frames
ON_GRID = 0.95  # of the keys, which follow a rate
OFF_GRID = 0.02  # of a frame; times of files are often rounded to milliseconds


@dataclass(frozen=True, eq=False)
class Curve:
    """One property of a node over time."""

    path: str
    """Key of `WIDTHS`."""
    times: Float64[np.ndarray, " keys"]
    """Seconds, ascending."""
    values: Float64[np.ndarray, "keys width"]
    """Quaternions are xyzw."""
    interpolation: str
    """STEP, LINEAR or CUBICSPLINE."""
    slopes: tuple[Float64[np.ndarray, "keys width"], Float64[np.ndarray, "keys width"]] | None
    """Of a CUBICSPLINE: before and after each key, a second."""

    def at(self, times: Float64[np.ndarray, " frames"]) -> Float64[np.ndarray, "frames width"]:
        """The values at these times, s; before the first key and after the last they are theirs.

        A CUBICSPLINE is the Hermite spline of the glTF 2.0 specification, appendix C.
        """
        before = np.clip(
            np.searchsorted(self.times, times + ON_KEY, side="right") - 1, 0, len(self.times) - 1
        )
        after = np.minimum(before + 1, len(self.times) - 1)
        gap = self.times[after] - self.times[before]
        passed = times - self.times[before]
        fraction = np.divide(passed, gap, out=np.zeros_like(passed), where=gap > 0)
        fraction = np.clip(fraction, 0.0, 1.0)[:, None]
        start, end = self.values[before], self.values[after]
        if self.interpolation == "STEP":
            return start
        if self.slopes is not None:
            t, t2, t3 = fraction, fraction**2, fraction**3
            arriving, leaving = self.slopes
            return (
                (2 * t3 - 3 * t2 + 1) * start
                + gap[:, None] * (t3 - 2 * t2 + t) * leaving[before]
                + (3 * t2 - 2 * t3) * end
                + gap[:, None] * (t3 - t2) * arriving[after]
            )
        if self.path == "rotation":
            first, second = (_rotations(quats) for quats in (start, end))
            turn = (first.inv() * second).as_rotvec()  # of the shorter arc
            return (first * Rotation.from_rotvec(fraction * turn)).as_quat()
        return start + fraction * (end - start)


def _rotations(quats: np.ndarray) -> Rotation:
    return Rotation.from_quat(quats)


def read_curve(document: Document, sampler: Item, path: str) -> Curve:
    """The curve of a sampler.

    Raises:
        ValueError: its arrays are not those of a curve.
    """
    interpolation = sampler.get("interpolation", "LINEAR")
    if interpolation not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise ValueError(f"interpolation {interpolation!r}; wanted STEP, LINEAR or CUBICSPLINE")
    times = document.array(sampler.get("input"))
    if times.shape[1] != 1:
        raise ValueError(f"times have {times.shape[1]} numbers for each key; wanted one")
    times = times[:, 0]
    if (np.diff(times) < 0).any() or np.abs(times).max() > LATEST:
        raise ValueError(f"the times of a {path} are not in order, or beyond {LATEST:g} s")
    values = document.array(sampler.get("output"))
    per_key = 3 if interpolation == "CUBICSPLINE" else 1
    if values.shape != (len(times) * per_key, WIDTHS[path]):
        raise ValueError(
            f"a {path} has {values.shape[0]} x {values.shape[1]} numbers for {len(times)} keys; "
            f"wanted {len(times) * per_key} x {WIDTHS[path]}"
        )
    slopes = None
    if interpolation == "CUBICSPLINE":
        arriving, values, leaving = np.moveaxis(values.reshape(len(times), 3, -1), 1, 0)
        slopes = arriving, leaving
    if path == "rotation" and (np.linalg.norm(values, axis=-1) < 0.1).any():
        raise ValueError("a rotation is no unit quaternion")
    return Curve(path, times, values, interpolation, slopes)


def frame_times(
    curves: list[Curve], fps: float | None, most: int
) -> tuple[Float64[np.ndarray, " frames"], float, tuple[str, ...]]:
    """The times at which an animation is sampled, s, the time of a frame, s, and remarks.

    Args:
        curves: of the animation.
        fps: Hz; None takes the rate at which its keys lie, or else `USUAL_RATE`.
        most: frames.

    Raises:
        ValueError: there would be more frames.
    """
    keys = np.unique(np.concatenate([curve.times for curve in curves]))
    keys = keys[np.diff(keys, prepend=-np.inf) > ON_KEY * 10]
    span = float(keys[-1] - keys[0])
    remarks = ()
    frame_time = 1.0 / fps if fps is not None else _time_of_frame(keys)
    if frame_time is None:
        frame_time = 1.0 / USUAL_RATE
        if len(keys) > 1:
            remarks = (f"its keys follow no frame rate; sampled at {USUAL_RATE:g} Hz",)
    if span / frame_time >= most:
        raise ValueError(
            f"{span:.4g} s at {1 / frame_time:.4g} frames per second; wanted at most {most} frames "
            "for a file of this size; give a lower fps=... in Python"
        )
    count = int(np.floor(span / frame_time + 0.01)) + 1
    return keys[0] + frame_time * np.arange(count), frame_time, remarks


def _time_of_frame(keys: Float64[np.ndarray, " keys"]) -> float | None:
    """The time, s, of which the gaps between most keys are multiples; None if there is none."""
    gaps = np.diff(keys)
    if not len(gaps):
        return None
    low, high = 1.0 / RATES[1], 1.0 / RATES[0]
    for gap in (float(np.median(gaps)), float(gaps.min())):
        if not low <= gap <= high:
            continue
        frames = np.round((keys - keys[0]) / gap)
        gap = float((keys - keys[0]) @ frames / (frames @ frames))  # the best for all keys
        off = np.abs((keys - keys[0]) / gap - np.round((keys - keys[0]) / gap))
        if (off < OFF_GRID).mean() >= ON_GRID:
            return gap
    return None
