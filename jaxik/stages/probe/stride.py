"""A probe that looks ahead: the ground between the last and the next foothold of each foot."""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxik.maths import vec
from jaxik.maths.parameter_tree import Leaf, duration, option, ratio, switch, threshold
from jaxik.maths.smoothing import Deviation, clip_to_one, lerp, settle, smoothstep
from jaxik.stages.inputs import STAIRS, GroundMoment, Inputs
from jaxik.world.frame import Contact, GroundHits, Landing, Stride, animated_ankles
from jaxik.world.skeleton import Rig
from jaxik.world.terrain import Hit

from . import foresight
from .base import climb, foot_heading, least_rise, make_rays, no_hit
from .support import AbstractSupportedProbe, Tread
from .swing import FAR, Level, s_curve

PATH_RAYS = 8  # between two footholds
WAY = np.array([0.0, *((np.arange(PATH_RAYS) + 0.5) / PATH_RAYS), 1.0])  # part of it, of each ray
STAYS = 2.0  # of a sole, that other ground has to support more than that to which a foot swings
AT_EDGE = 0.3  # of a sole, that a place costs whose ball is at an edge: predictions are not exact
HOLDS = 0.3  # of a sole, with which ground holds a foot that stands on it
SOONEST, LATEST = 0.06, 0.2  # s, in which a foot slides to what holds it better
# How far beyond a predicted foothold a foot lands, in parts of the way that it has left: near the
# median and the quantiles of 10, 30, 70 and 90 % half-way through 63 swings of two people on uneven
# ground (0.2, -0.2, 0.02, 0.33, 0.9); of sets near these, that with the least error of ankles.
PLACES = np.array([0.2, -0.1, 0.05, 0.4, 0.8])


class StrideProbe(AbstractSupportedProbe):
    """Rays at the last and at the next foothold, joined by a smooth curve.

    A swinging foot leaves the ground of its last foothold and arrives on that of its next, so the
    ground under it goes from one height to the other along `s = x^k / (x^k + (1 - x)^k)`. Here `x`
    is the time of the swing between `rise_start` and `rise_end` and `k` the `steepness`; 1.875
    gives the middle slope of the minimum-jerk quintic (Flash and Hogan 1985). The foot thus starts
    to rise before the obstacle is under it.

    Only a step is curved in this way. The slope that both footholds and the line between them share
    is followed as the foot goes. The ground is sensed below the ball of the foot and continued to
    below the ankle along the plane of the hits, as far as the ground there goes as well, so that on
    a slope the whole sole is on the ground.
    Feet keep the slope of the ground in their swing, so that they neither leave nor meet it level.

    The animation may provide the footholds (`Frame.stride`). If not, or with `use_strides` off,
    they are predicted from the character's velocity: feet stand for `stance_time` and swing for
    `swing_time`, from as far ahead of the hip to as far behind it (Raibert 1986). A single frame
    tells little of that. With `remember_swings` on, the last foothold is where the foot stood and
    the next where its swing so far leads (see `foresight`); the times are then soon those of its
    own steps. As long as it is uncertain where that is, the ground is the mean of that for five
    places about it; with `slide_to_support` on, the foot then keeps to the tread on which it will
    land, and slides aside for that.

    A next foothold counts less and less if the way there takes a step of more than `max_step_up` or
    `max_step_down`, or if its ground is steeper than `max_slope`, so that a foot neither drops off
    a ledge nor snaps onto a wall, but climbs stairs. A foot that stands has no other foothold's
    ground. Rays along the way find the highest edge over the line between the footholds, up to
    `max_step_up` high; the foot clears it in one arc, of which its animated lift, less `clearance`,
    is a part.
    """

    ray_up: Leaf = threshold(
        1, 0, 2, "Height above the character's level at which rays start.", unit="m"
    )
    ray_down: Leaf = threshold(
        1, 0, 2, "Depth below the character's level to which rays look.", unit="m"
    )
    use_strides: Leaf = switch(
        True, "Whether the animation's footholds are used; off, they are predicted."
    )
    rise_start: Leaf = ratio(
        0, 0, 0.45, "Part of the swing after which the foot begins to change its height."
    )
    rise_end: Leaf = ratio(
        1,
        0.55,
        1,
        "Part of the swing after which the foot has its next foothold's height.",
        above="rise_start",
    )
    steepness: Leaf = ratio(
        1.875, 1, 4, "How much faster than evenly the height changes in the middle of the swing."
    )
    stance_time: Leaf = duration(
        0.65,
        0.2,
        1.5,
        "How long a foot stands, where the animation does not give its footholds.",
        follows="time",
    )
    swing_time: Leaf = duration(
        0.55,
        0.1,
        1,
        "How long a foot swings, where the animation does not give its footholds.",
        follows="time",
    )

    remember_swings: bool = option(
        False,
        "Whether footholds that the animation does not give are predicted from each swing so "
        "far, which takes memory and six times as many rays, not from each frame alone.",
    )

    def init(self, rig: Rig) -> foresight.Foresight | None:
        if not self.remember_swings:
            return None
        return foresight.Foresight(foresight.no_swings(rig), foresight.no_plan(rig))

    def watch(self, inputs: Inputs, contact: Contact, foot_height: Array) -> foresight.Feet | None:
        return foresight.watch(inputs, contact, foot_height) if self.remember_swings else None

    def advance(
        self,
        now: GroundMoment,
        watched: foresight.Feet | None,
        state: foresight.Foresight | None,
    ) -> tuple[foresight.Foresight | None, Stride | None]:
        if watched is None or state is None:
            return None, None
        times = self.stance_time, self.swing_time
        swings, next_ws = foresight.follow_swings(now, watched, state.swings, *times)
        last_ws, plan = watched.ball_ws - swings.travelled_ws, state.plan
        until = foresight.time_left(swings)
        sure = jnp.zeros_like(until)
        if self.slide_to_support:
            place_ws = jnp.where(swings.planted[:, None] > 0.5, last_ws, next_ws)
            sure = foresight.sureness(watched, swings, next_ws)
            plan = self._plan(now, watched, place_ws, state, swings, sure, until)
            last_ws += plan.last_ws
            next_ws += vec.scale(watched.ahead_ws, plan.slide)
        animated = watched.frame.stride
        stride = self._known_or(animated, last_ws, next_ws, swings.fraction, watched.up_ws)
        planned = foresight.PlannedStride(
            **{field.name: getattr(stride, field.name) for field in dataclasses.fields(stride)},
            moved_ws=vec.scale(plan.moved_ws, 1.0 - stride.known),
            support=lerp(plan.last_share, plan.share, self._eased(stride.fraction)),
            sure=lerp(sure, jnp.ones_like(sure), stride.known),
            until=until,
        )
        return foresight.Foresight(swings, plan), planned

    def _plan(
        self,
        now: GroundMoment,
        feet: foresight.Feet,
        place_ws: Array,
        before: foresight.Foresight,
        swings: foresight.Swings,
        sure: Array,
        until: Array,
    ) -> foresight.Plan:
        """Where each foot will stand; late in its swing it keeps to the tread that it goes to.

        A foot that lands where hardly anything holds it, as a swing may end before it is expected
        to, slides on to what does.

        Args:
            now: the frame.
            feet: what it shows.
            place_ws: where the ball of each foot would stand, m.
            before: memory.
            swings: how far the feet are.
            sure: 0..1, how sure it is where swings lead.
            until: s, until they land.
        """
        inputs = Inputs(feet.rig, now.terrain, feet.frame, now.gate)
        level, plan = Level.of(inputs), before.plan
        planted, stood = swings.planted > 0.5, before.swings.planted > 0.5
        swings_on, rests = now.started & ~planted & ~stood, now.started & planted
        lands = rests & ~stood
        origin = vec.dot(level.origin_ws, level.up_ws)
        # Where the foot stands or stood, from its animated foothold.
        there_ws = jnp.where((planted == stood)[:, None], plan.last_ws, plan.moved_ws)
        there_ws = jnp.where(now.started, there_ws, 0.0)
        sure = jnp.where(planted, 1.0, sure)
        tread = Tread(
            plan.height - origin,
            jnp.where(swings_on, STAYS * sure, 0.0),
            jnp.where(rests, 0.0, AT_EDGE),
        )
        least = {"min_sole": jnp.where(rests, HOLDS, self.min_sole)}
        supports = dataclasses.replace(self, **least).better_support(
            inputs,
            level,
            (place_ws + jnp.where(rests[:, None], there_ws, 0.0))[None],
            feet.ahead_ws[None],
            feet.foot_height,
            jnp.ones_like(sure),
            tread,
        )
        support = jax.tree.map(lambda x: x[0], supports)
        slide = jnp.where(rests & stood, 0.0, sure * support.slide)
        jump = jnp.where(lands, 0.0, plan.left.value + plan.slide) - slide
        time = jnp.where(until > LATEST, LATEST, jnp.where(until < SOONEST, SOONEST, until))
        left = settle(plan.left._replace(value=jump), time, now.dt)
        left = Deviation(*(jnp.where(swings_on | rests, x, 0.0) for x in left))

        slide_ws, left_ws = vec.scale(feet.ahead_ws, slide), vec.scale(feet.ahead_ws, left.value)
        last_ws = there_ws + jnp.where(planted[:, None], slide_ws, 0.0)
        moved_ws = last_ws + jnp.where(planted[:, None], left_ws, 0.0)
        moved_ws = lerp(moved_ws, slide_ws + left_ws, self._eased(swings.fraction)[..., None])
        last_share = jnp.where(now.started & ~lands, plan.last_share, support.share)
        slide = jnp.where(planted, 0.0, slide)
        height = support.height + origin
        return foresight.Plan(last_ws, slide, left, moved_ws, height, support.share, last_share)

    def sense(self, inputs: Inputs, contact: Contact, foot_height: Array) -> GroundHits:
        level = Level.of(inputs)
        remembered = self.remember_swings
        stride = inputs.frame.stride if remembered else self._stride(inputs, contact, level)
        support = None
        if self.slide_to_support:
            footholds_ws = jnp.stack([stride.last_ws, stride.next_ws])
            ahead_ws = _headings(inputs, stride, level.up_ws)
            supports = self.better_support(
                inputs, level, footholds_ws, ahead_ws, foot_height, stride.known
            )
            slides_ws, shares = vec.scale(ahead_ws, supports.slide), supports.share
            fraction = self._eased(stride.fraction)
            support = lerp(shares[0], shares[1], fraction)
            moved_ws = lerp(slides_ws[0], slides_ws[1], fraction[..., None])
            last_ws, next_ws = stride.last_ws + slides_ws[0], stride.next_ws + slides_ws[1]
            if isinstance(stride, foresight.PlannedStride):
                assert stride.moved_ws is not None and stride.support is not None
                moved_ws += stride.moved_ws
                support = lerp(stride.support, support, stride.known)
            stride = dataclasses.replace(stride, last_ws=last_ws, next_ws=next_ws)
            frame = inputs.frame.with_moved_feet(moved_ws)
            inputs = dataclasses.replace(inputs, frame=frame)
        ground = self._ground_around if remembered else self._ground_of
        hits = ground(inputs, foot_height, level, stride)
        until = stride.until if isinstance(stride, foresight.PlannedStride) else None
        return dataclasses.replace(hits, support=support, until=until)

    def _ground_around(
        self, inputs: Inputs, foot_height: Array, level: Level, stride: Stride
    ) -> GroundHits:
        """The mean ground of strides to five places about next footholds that are predicted."""
        ball = inputs.frame.world_from_model.apply(inputs.frame.pose.toe.pos)
        way = vec.reject(stride.next_ws - ball, level.up_ws)
        assert isinstance(stride, foresight.PlannedStride) and stride.sure is not None
        parts = jnp.asarray(PLACES, way.dtype)[:, None] * (1.0 - stride.sure)
        places_ws = stride.next_ws + vec.scale(way, parts)
        grounds = jax.vmap(
            lambda next_ws: self._ground_of(
                inputs, foot_height, level, dataclasses.replace(stride, next_ws=next_ws)
            )
        )(places_ws)
        return _mean_ground(grounds, level.up_ws)

    def _eased(self, fraction: Array) -> Float[Array, " legs"]:
        """0..1, how far feet are from their last foothold to their next, eased in and out."""
        since_start = fraction - self.rise_start
        fraction = vec.safe_divide(since_start, self.rise_end - self.rise_start)
        return s_curve(fraction, self.steepness)

    def _ground_of(
        self, inputs: Inputs, foot_height: Array, level: Level, stride: Stride
    ) -> GroundHits:
        """The ground under feet in these strides."""
        frame = inputs.frame
        way_ws = stride.next_ws - stride.last_ws
        fractions = jnp.asarray(WAY, way_ws.dtype)[:, None]
        path_ws = stride.last_ws + vec.scale(way_ws, fractions)
        if stride.aside_ws is not None:
            path_ws += vec.scale(stride.aside_ws, 4.0 * fractions * (1.0 - fractions))
        ankle, ball = animated_ankles(frame).pos, frame.world_from_model.apply(frame.pose.toe.pos)
        arm = vec.reject(ankle - ball, level.up_ws)
        heels_ws = path_ws[jnp.array([0, -1])] + arm
        hits = self.ground_at(inputs, level, jnp.concatenate([path_ws, heels_ws]))
        # (points legs), as `path_ws`, and (ends legs), below the ankle at both footholds.
        path, heels = (jax.tree.map(lambda x: x[at], hits) for at in (np.s_[:-2], np.s_[-2:]))  # noqa: B023
        if self.check_support:
            ends = self.ground_at(inputs, level, path_ws[jnp.array([0, -1])], stood_on=True)
            path = jax.tree.map(lambda x, y: jnp.concatenate([y[:1], x[1:-1], y[1:]]), path, ends)
        heights = level.height(path.point)
        low, high = heights[0], heights[-1]
        last, next_ = (jax.tree.map(lambda x: x[end], path) for end in (0, -1))  # noqa: B023
        fraction = self._eased(stride.fraction)
        found = lerp(last.found, next_.found, fraction)  # a foot that stands has no other ground
        # Without a last foothold, the ground is that of the next, or without that the root's level.
        low = lerp(next_.found * high, low, last.found)
        low, high, fraction, found = vec.stacked_barrier(low, high, fraction, found)
        normal = lerp(next_.normal, last.normal, last.found[..., None])

        way = vec.reject(way_ws, level.up_ws)
        climbs = self.climb(normal, way, level.up_ws), self.climb(next_.normal, way, level.up_ws)
        (slope,) = vec.stacked_barrier(least_rise(high - low, *climbs))
        step = high - low - slope
        evened = jnp.concatenate([low[None], heights[1:]]) - slope * fractions
        (evened,) = vec.stacked_barrier(evened)
        trust = next_.found * self.gentleness(next_.normal, level.up_ws)
        trust *= 1.0 - smoothstep(_least_step(evened, path.found, self.excess) / self.step_fade)
        step, trust = vec.stacked_barrier(step, trust)

        covered = vec.safe_divide(vec.dot(ball - stride.last_ws, way), vec.dot(way, way))
        height = low + trust * (slope * clip_to_one(covered) + step * fraction)
        (height,) = vec.stacked_barrier(height)
        normal += vec.scale(next_.normal - normal, trust * fraction)
        normal = vec.normalize(normal, level.up_ws)

        between = evened[1:-1] - low, path.found[1:-1]
        over = self.highest(inputs, between[0] - jnp.where(step > 0, step, 0.0), between[1])
        chord = trust * step * fractions[1:-1]
        edge = self.highest(inputs, between[0] - chord, between[1])
        below = self.below_others(inputs, height, normal, found)
        stair = _least_step(evened, path.found, jnp.abs)
        step = jnp.where(step > stair, stair, jnp.where(step < -stair, -stair, step))
        ahead = self.above_others(inputs, high - slope, height, found)
        step, ahead, over, edge, below = vec.stacked_barrier(step, ahead, over, edge, below)
        swing = self.swing(inputs, stride, step, ahead, over, trust, below)
        height += self.clearance_over_edges(inputs, stride, swing, foot_height, edge)
        share = trust * fraction
        parts = jnp.stack([1.0 - share, share]) * heels.found
        heel_rises = level.height(heels.point) - jnp.stack([low, high])
        heel_rise = vec.safe_divide(jnp.sum(parts * heel_rises, 0), jnp.sum(parts, 0))
        # The ground under the ball may be a small piece; the heel stands on what is below it.
        plane_rise = self.climb(normal, arm, level.up_ws)
        rise = lerp(plane_rise, least_rise(plane_rise, heel_rise), jnp.sum(parts, 0))
        height, rise, plane_rise = vec.stacked_barrier(height + rise, rise, plane_rise)
        normal = _tilted(normal, arm, rise, level.up_ws)
        height = jnp.where(found > 0, height, 0.0)
        ankle_ws = level.project(ankle) + vec.scale(level.up_ws, height)
        platform = last.platform
        if platform is not None:
            arriving = (last.found <= 0) | (trust * fraction > 0.5)
            platform = jnp.where(arriving, next_.platform, platform)
        normal = vec.normalize(lerp(level.up_ws, normal, found[..., None]), level.up_ws)
        hit = Hit(ankle_ws, normal, self.ray_up - height, found, platform)
        rays = make_rays(hit, self.ray_up, self.ray_down, self.layers)
        sure = stride.sure if isinstance(stride, foresight.PlannedStride) else stride.known
        assert sure is not None
        turns = jnp.ones_like(found)
        lift, pitch = found * swing.lift, found * swing.pitch
        end_rise = lerp(plane_rise, least_rise(plane_rise, heel_rises[-1]), heels.found[-1])
        landing = Landing(
            way_ws=vec.reject(stride.next_ws - ball, level.up_ws)
            + vec.scale(level.up_ws, high + end_rise - height),
            velocity_ws=vec.reject(jnp.broadcast_to(frame.velocity_ws, ball.shape), level.up_ws),
            fraction=stride.fraction,
            certain=sure * trust,
            root_height=vec.dot(frame.world_from_model.pos, inputs.terrain.up_ws),
        )
        nothing = no_hit(hit)
        return GroundHits(hit, nothing, nothing, turns, rays, lift, pitch, landing=landing)

    def _stride(self, inputs: Inputs, contact: Contact, level: Level) -> Stride:
        """The stride of the animation where it is known, else one predicted from velocity."""
        frame = inputs.frame
        velocity = vec.reject(frame.velocity_ws, level.up_ws)
        ball = level.project(frame.world_from_model.apply(frame.pose.toe.pos))
        ankle, hip = animated_ankles(frame).pos, frame.world_from_model.apply(frame.pose.hip.pos)
        ahead = foresight.time_ahead(velocity, ankle - hip)
        times = self.stance_time, self.swing_time
        now = foresight.instant(ahead, contact.planted, *times, inputs.gate)
        last_ws = ball + vec.scale(velocity, -now.since_last)
        next_ws = ball + vec.scale(velocity, now.until_next)
        return self._known_or(frame.stride, last_ws, next_ws, now.fraction, level.up_ws)

    def _known_or(
        self, labelled: Stride, last_ws: Array, next_ws: Array, fraction: Array, up_ws: Array
    ) -> Stride:
        """The stride of the animation where it is known and wanted, else the one that is given."""
        known = (labelled.known > 0.5) & self.use_strides

        def where_known(way_ws: Array | None) -> Array | None:
            if way_ws is None:
                return None
            return jnp.where(known[..., None], vec.reject(way_ws, up_ws), 0.0)

        return Stride(
            labelled.standing,
            jnp.where(known[..., None], labelled.last_ws, last_ws),
            jnp.where(known[..., None], labelled.next_ws, next_ws),
            jnp.where(known, labelled.fraction, fraction),
            known.astype(fraction.dtype),
            where_known(labelled.aside_ws),
            where_known(labelled.last_ahead_ws),
            where_known(labelled.next_ahead_ws),
        )

    def ground_at(
        self, inputs: Inputs, level: Level, points_ws: Array, stood_on: bool = False
    ) -> Hit:
        """The ground above or below these points."""
        above = level.project(points_ws) + vec.scale(level.up_ws, self.ray_up)
        reach, margin = self.ray_up + self.ray_down, self.margin_at(level, points_ws)
        return self.cast(inputs, above, reach, self.layers, margin, stood_on)

    def margin_at(self, level: Level, points_ws: Array) -> Array:
        """How much higher and lower than a step the ground may be there, m: as stairs go."""
        away = vec.length(level.project(points_ws) - level.origin_ws)
        return jnp.where(away > self.max_step_up, STAIRS * (away - self.max_step_up), 0.0)


def _tilted(normal: Array, way: Array, rise: Array, up_ws: Array) -> Float[Array, "legs 3"]:
    """The normal of ground turned across a level way, m, so that it rises by so much on it, m."""
    steeper = vec.safe_divide(rise - climb(normal, way, up_ws), vec.dot(way, way))
    facing = vec.dot(normal, up_ws)[..., None]
    return vec.normalize(normal - facing * vec.scale(way, steeper), up_ws)


def _headings(inputs: Inputs, stride: Stride, up_ws: Array) -> Float[Array, "ends legs 3"]:
    """Where each foot points at its last and next foothold, unit, perpendicular to up."""
    present, _ = foot_heading(inputs)
    ends = (stride.last_ahead_ws, stride.next_ahead_ws)
    return jnp.stack([present if x is None else vec.across(x, up_ws, present) for x in ends])


def _least_step(
    heights: Array, found: Array, size: Callable[[Array], Array]
) -> Float[Array, " legs"]:
    """The size of the highest step that cannot be avoided on a way, m; `FAR` without ground.

    From the last foothold to the next, any points of the way may be stepped on in turn; of all such
    choices, that with the lowest highest step counts. So stairs are no ledge.

    Args:
        heights: of the ground along the way, without its slope (points, legs), m.
        found: of that ground.
        size: of steps of these heights, m.
    """
    highest = [jnp.full_like(heights[0], -FAR)]
    for point in range(1, len(heights)):
        steps = size(heights[point] - heights[:point])
        reached = (jnp.where(a > b, a, b) for a, b in zip(highest, steps, strict=True))
        least = functools.reduce(lambda a, b: jnp.where(a < b, a, b), reached)
        highest += vec.stacked_barrier(jnp.where(found[point] > 0, least, FAR))
    return highest[-1]


def _mean_ground(grounds: GroundHits, up_ws: Array) -> GroundHits:
    """The mean of several grounds (places legs) under feet that are not sure where they land."""
    mean = jax.tree.map(lambda x: jnp.mean(x, 0), (grounds.ankle, grounds.lift, grounds.pitch))
    first = jax.tree.map(lambda x: x[0], grounds)
    ankle = dataclasses.replace(
        mean[0],
        normal=vec.normalize(mean[0].normal, up_ws),
        platform=first.ankle.platform,
    )
    return dataclasses.replace(first, ankle=ankle, lift=mean[1], pitch=mean[2])
