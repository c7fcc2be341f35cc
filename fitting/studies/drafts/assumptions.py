"""What a first experiment takes for granted of its clips, and how well the clips bear it out."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.datasets import coverage
from fitting.datasets.clips import Clip, flight, summary
from fitting.datasets.clips.rigs import USUAL_ERROR, measure_soles
from fitting.datasets.terrain.reconstruction import Reconstruction
from fitting.experiments.problems import ClipData
from fitting.studies.motions.capture_check import stances_of
from jaxik.world import body

FEW_STANCES = 6  # of a foot
SCATTER = 0.03  # m, of soles above the ground, from which on the two do not belong together


class Assumption(NamedTuple):
    """Something taken for granted."""

    topic: str
    text: str
    """What is assumed, and from what."""
    advice: str = ""
    """What to check or to do better; empty where the clip bears it out."""


def of_clip(
    data: ClipData,
    ground: Reconstruction | None,
    *,
    base_is_own: bool,
    sole_is_given: bool = False,
) -> list[Assumption]:
    """The assumptions about one clip of an experiment.

    Args:
        data: the loaded clip.
        ground: what the terrain was reconstructed from; None for a terrain that was given.
        base_is_own: whether the flat animation was given, and not made from the capture.
        sole_is_given: whether heights over the sole were given, and not measured or estimated.
    """
    return [
        *_body(data.reference),
        *_legs(data.reference),
        _soles(data.reference, is_given=sole_is_given),
        *_ground(data, ground),
        _base(data, base_is_own=base_is_own),
    ]


def _body(clip: Clip) -> Iterator[Assumption]:
    length = body.leg_length(clip.rig)
    text = f"{clip.scale:.6g} m per unit of the file, {clip.up_axis} up: legs {length:.2f} m long"
    yield Assumption("body", text)
    for remark in clip.remarks:
        yield Assumption("file", remark, "see `jaxik inspect`")
    if text := flight.describe(clip):
        yield Assumption("air", text)


def _legs(clip: Clip) -> Iterator[Assumption]:
    described = summary.describe(clip)
    for leg, name in enumerate(clip.rig.names):
        bend = knee_bend(clip)[:, leg]
        low, high = np.degrees(np.percentile(bend, [1, 99]))
        text = f"the {name} knee bends by {low:.0f}° to {high:.0f}°"
        yield Assumption("knees", text)
    for name, leg in described["legs"].items():
        text = f"the {name} foot {summary.contact_text(described, leg)}"
        few = leg["contacts"] < FEW_STANCES
        yield Assumption(
            "contacts", text, "few steps determine little: take a longer clip" if few else ""
        )


def _soles(clip: Clip, *, is_given: bool) -> Assumption:
    """How high balls are over their soles, which shifts reconstructed ground, and how sure."""
    heights = np.asarray(clip.rig.ball_height)
    text = f"balls are {100 * heights.mean():.1f} cm over their soles"
    if is_given:
        return Assumption("soles", f"{text}, as was given")
    labels = clip.stance_labels()
    soles = measure_soles(clip.rig, clip.positions_ws, clip.rotations_ws, labels)
    if soles.measured.all():
        spread = 100 * np.ptp(heights) / 2
        text += f", measured over the level floor at height 0 (feet differ by ±{spread:.1f} cm)"
        return Assumption("soles", text)
    return Assumption(
        "soles",
        f"{text}, estimated from the feet's length, give or take {100 * USUAL_ERROR:.0f} cm",
        "better: measure it, and give it as --sole",
    )


def knee_bend(clip: Clip) -> Float[np.ndarray, "frames legs"]:
    """Angle between thigh and shin, rad: 0 in a straight leg."""
    hip, knee, ankle = (clip.joints_ws(role) for role in range(3))
    thigh, shin = knee - hip, ankle - knee
    lengths = np.linalg.norm(thigh, axis=-1) * np.linalg.norm(shin, axis=-1)
    cosines = np.sum(thigh * shin, axis=-1) / np.maximum(lengths, 1e-12)
    return np.arccos(np.clip(cosines, -1.0, 1.0))


def _ground(data: ClipData, ground: Reconstruction | None) -> Iterator[Assumption]:
    stances = stances_of(data)
    covered = ~np.isnan(stances.ground)
    if ground is not None:
        error = 100 * ground.predictions[ground.chosen].rms
        text = (
            f"reconstructed from {int(ground.stances.used.sum())} stances ({ground.chosen}); each "
            f"is predicted from the others to {error:.1f} cm (rms)"
        )
        doubt = "it is not to be trusted; " if 100 * SCATTER < error else ""
        yield Assumption("ground", text, f"{doubt}better: a scan of the ground, with --terrain")
    elif not covered.any():
        yield Assumption("ground", "no foot stands on it", "better: a clip in which the feet stand")
        return
    else:
        gap = (stances.sole - stances.ground)[covered]
        text = (
            f"below {covered.mean():.0%} of the stances; soles stand {100 * np.median(gap):.1f} cm "
            f"above it, give or take {100 * np.std(gap):.1f} cm"
        )
        advice = "does this ground belong to this clip?"
        fits = covered.mean() >= coverage.ENOUGH and np.std(gap) < SCATTER
        yield Assumption("ground", text, "" if fits else advice)


def _base(data: ClipData, *, base_is_own: bool) -> Assumption:
    if base_is_own:
        return Assumption("base", f"{data.base.source}; its root {data.root.reason}")
    return Assumption(
        "base",
        "made from the capture, with the ground taken out from under the feet",
        "better: the flat animation that the game plays, with --base",
    )
