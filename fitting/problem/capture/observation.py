"""What a capture would show of a motion, were it as its numbers say.

A residual is what the capture would show minus what it shows. The other way round, captured motion
that is corrected, and so interpolated and scaled, would have less noise for some numbers than for
others, and the fit would choose those.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

import jaxik
from jaxik.maths import quat, vec
from jaxik.world.skeleton import Transform

from .parameters import Capture


def shown(
    capture: Capture, rig: jaxik.Rig, frames: jaxik.Frame, legs: jaxik.LegPose, pelvis: Transform
) -> tuple[jaxik.LegPose, Transform]:
    """Legs, of which knee and ankle count, and pelvis as the capture of a clip would show them.

    Args:
        capture: of the clip.
        rig: whose feet these are.
        frames: of the clip.
        legs: (frames legs), world space.
        pelvis: (frames), world space.
    """
    centre_ws = centre_of(frames)

    def placed(joint: Transform) -> Transform:
        pos = centre_ws + capture.scale * (joint.pos - centre_ws)
        return _delayed(capture, frames, Transform(pos, joint.rot))

    legs = dataclasses.replace(
        legs, knee=placed(legs.knee), ankle=placed(_with_offsets(capture, rig, legs.ankle))
    )
    return legs, placed(pelvis)


def centre_of(frames: jaxik.Frame) -> Float[Array, "3"]:
    """The middle of a clip on its floor, m, about which ground is tilted and lengths are scaled."""
    return jnp.mean(frames.world_from_model.pos, axis=0)


def _with_offsets(capture: Capture, rig: jaxik.Rig, ankle: Transform) -> Transform:
    """The ankle where its capture is, turned as far as that of the ball turns the foot."""
    ankle_from_foot = Transform(jnp.zeros_like(rig.ankle_from_foot[..., 1:]), rig.ankle_from_foot)
    offset = _in_foot(rig, capture.ankle_outward, capture.ankle_up, capture.ankle_forward)
    drop = rig.ball_height - rig.ankle_height
    reach = jnp.sqrt(jnp.maximum(rig.foot**2 - drop**2, (0.1 * rig.foot) ** 2))
    ball = vec.stack(jnp.zeros_like(drop), drop, reach)
    captured = ball + _in_foot(rig, capture.ball_outward, capture.ball_up, 0.0)
    turn = quat.shortest_arc(_unit(ball), _unit(captured), jnp.eye(3, dtype=ball.dtype)[0])
    return Transform(
        ankle.pos + ankle.turn(ankle_from_foot.turn(offset)),
        ankle.apply_rot(ankle_from_foot.turn_rot(turn)),
    )


def _in_foot(
    rig: jaxik.Rig, outward: Array | float, up: Array | float, forward: Array | float
) -> Float[Array, "legs 3"]:
    """An offset along the axes of each foot: x is left, y up and z forward."""
    return jnp.stack([rig.side * outward, 0.0 * rig.side + up, 0.0 * rig.side + forward], axis=-1)


def _unit(vectors: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    return vec.scale(vectors, 1.0 / vec.length(vectors))


def delayed(
    capture: Capture, frames: jaxik.Frame, values: Float[Array, " frames *shape"]
) -> Float[Array, " frames *shape"]:
    """Numbers of each frame as they were the capture's time shift before.

    Cubic between frames (Catmull and Rom 1974), so that derivatives have no jumps; what was before
    a clip or comes after it is taken to be as at its end.
    """
    places, weights = _taps(capture, frames)
    return _mixed([values[place] for place in places], weights)


def _delayed(capture: Capture, frames: jaxik.Frame, joint: Transform) -> Transform:
    """The same of a joint; quaternions of which one is the other way round are turned first."""
    places, weights = _taps(capture, frames)
    near, rots = joint.rot[places[1]], [joint.rot[place] for place in places]
    alike = [jnp.where(quat.dot(rot, near)[..., None] < 0, -rot, rot) for rot in rots]
    return Transform(
        _mixed([joint.pos[place] for place in places], weights),
        quat.normalize(_mixed(alike, weights)),
    )


def _taps(
    capture: Capture, frames: jaxik.Frame
) -> tuple[list[Int[Array, " frames"]], list[Float[Array, ""]]]:
    """The four frames about what each frame shows, and their weights."""
    place = -capture.time_shift / frames.dt[-1]
    whole = jnp.floor(jax.lax.stop_gradient(place))
    f = place - whole
    count = len(frames.dt)
    first = jnp.arange(count) + whole.astype(jnp.int32)
    return [jnp.clip(first + step, 0, count - 1) for step in (-1, 0, 1, 2)], [
        f * (-0.5 + f * (1.0 - 0.5 * f)),
        1.0 + f**2 * (1.5 * f - 2.5),
        f * (0.5 + f * (2.0 - 1.5 * f)),
        f**2 * (0.5 * f - 0.5),
    ]


def _mixed(values: Sequence[Array], weights: Sequence[Array]) -> Array:
    first, *others = (weight * value for weight, value in zip(weights, values, strict=True))
    return sum(others, first)
