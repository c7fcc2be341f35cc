"""Mutants that no test can catch or should, with the reason: they are not run and not counted.

An entry holds the module and the line before and after the change. An ellipsis at the end of both
stands for the rest of the line, and an empty second line for any change of the first.
"""

from typing import NamedTuple


class Explained(NamedTuple):
    """A mutant, or several of one kind, and why it is as good as the original."""

    path: str
    before: str
    after: str
    reason: str

    def matches(self, path: str, before: str, after: str) -> bool:
        """Whether this entry is about a mutant."""
        if path != self.path or not _agrees(self.before, before):
            return False
        return not self.after or _agrees(self.after, after)


def _agrees(pattern: str, line: str) -> bool:
    if pattern.endswith("..."):
        return line.startswith(pattern.removesuffix("..."))
    return line == pattern


STAND_IN = "stands in where its result is not used, so that no derivative becomes NaN"
SPEED = "changes time or memory, no result"
GUARD = "guards against a mistake of the caller, which none makes"
BOUNDARY = "both sides are equal at the boundary"
ROUNDING = "a few more or less roundings are as good"
LOOK = "changes how a picture looks, which the eye judges"
CELL = "np.clip(np.floor((corners.max(axis=1) + pad - corner) / pitch).astype(int)"
EXPLAINED = [
    Explained("fitting/report/plots/calibration_plots.py", "Line2D([], [], color=...", "", LOOK),
    Explained(
        "fitting/report/plots/fit_plots.py",
        "edges = np.linspace(-5.0, 5.0, 41)",
        "edges = np.linspace(-5.0, 5.0, 40)",
        LOOK,
    ),
    Explained("fitting/datasets/clips/formats/gltf/writer.py", "GREY = [...", "", LOOK),
    Explained(
        "fitting/inference/sampling/sampler.py",
        "self._islands = find_islands(self._chain.u[length // 2 : length])",
        "self._islands = find_islands(self._chain.u[length // 3 : length])",
        "the last two thirds of a chain teach as much as its last half",
    ),
    Explained(
        "jaxik/solvers/two_bone.py",
        "known = span > tiny**0.5",
        "known = span > tiny** 1.5",
        "nearer to the pole than 1e-8, rounding decides",
    ),
    Explained("jaxik/batching/lanes.py", "@jax.checkpoint", "", SPEED),
    Explained("jaxik/batching/primitives.py", "UNROLLED_SUM = 8...", "UNROLLED_SUM = ...", SPEED),
    Explained(
        "jaxik/maths/gate.py",
        "weight = jax.nn.sigmoid(jnp.where(infinite, 0.0, gap)...",
        "weight = jax.nn.sigmoid(jnp.where(infinite, ...",
        STAND_IN,
    ),
    Explained(
        "jaxik/maths/struct.py",
        "value.__dict__.update(zip(names, (*leaf_values, *static_values), strict=True))",
        "value.__dict__.update(zip(names, (*leaf_values, *static_values), strict=False))",
        GUARD,
    ),
    Explained(
        "jaxik/maths/vec.py",
        "length = jnp.sqrt(jnp.where(known, square, 1.0))",
        "length = jnp.sqrt(jnp.where(known, square, 2.0))",
        STAND_IN,
    ),
    Explained(
        "jaxik/maths/parameter_tree.py",
        'per_leg = getattr(owner, "per_leg", True)',
        'per_leg = getattr(owner, "per_leg", False)',
        "all owners are rules, which have one",
    ),
    Explained(
        "jaxik/pipeline/simulation.py",
        "clip = (frames, read_tracks(ik, tracks, count, rig.side.shape[0]))",
        "clip = (frames, read_tracks(ik, tracks, count, rig.side.shape[ -1]))",
        "there is one axis",
    ),
    Explained(
        "jaxik/solvers/pole.py",
        "away = vec.dot(to_target, to_target) > jnp.finfo(to_target.dtype).eps ** 2",
        "away = vec.dot(to_target, to_target) > jnp.finfo(to_target.dtype).eps ** 3",
        "a distance of 1e-16 m or 1e-24 m is nothing either way",
    ),
    Explained(
        "jaxik/solvers/reach.py",
        "fraction = jnp.where(beyond, excess, 0.0) / jnp.where(has_room, room, 1.0)",
        "fraction = jnp.where(beyond, excess, 0.0) / jnp.where(has_room, room, 2.0)",
        STAND_IN,
    ),
    Explained(
        "jaxik/stages/fade.py",
        "within = jnp.where(beyond, reach / jnp.where(beyond, distance, 1.0), 1.0)",
        "within = jnp.where(beyond, reach / jnp.where(beyond, distance, 2.0), 1.0)",
        STAND_IN,
    ),
    Explained(
        "jaxik/stages/pelvis/games.py",
        "fraction = smoothing.fraction_of_speed(self.speed, now.dt, goal - state.height)",
        "fraction = smoothing.fraction_of_speed(self.speed, now.dt, goal + state.height)",
        "the gap only tells whether to jump, over less than 0.1 mm",
    ),
    Explained(
        "jaxik/stages/probe/stride.py",
        "margin = jnp.where(away > self.max_step_up, ...",
        "margin = jnp.where(away >= self.max_step_up, ...",
        BOUNDARY,
    ),
    Explained(
        "jaxik/stages/probe/limits.py",
        "above = jnp.where(above > 0, above, 0.0)",
        "above = jnp.where(above > 0, above, -1.0)",
        "what a ray from further up hits besides does not lie below what the first ray hits",
    ),
    Explained(
        "jaxik/stages/target.py",
        "return jnp.where(now.started, climb, 0.0)",
        "return jnp.where(now.started, climb, -1.0)",
        "in the first frame heights jump to their goals, whatever they were",
    ),
    Explained("jaxik/world/cells.py", "SPLIT = 4...", "SPLIT = 3...", SPEED),
    Explained(
        "jaxik/world/cells.py",
        f"high = {CELL}, 0, last)",
        f"high = {CELL}, -1, last)",
        "the grid begins below all corners",
    ),
    Explained(
        "jaxik/world/cells.py",
        "across, along = np.floor(size / pitch + 0.37).astype(int) + 1",
        "across, along = np.floor(size / pitch + 1.37).astype(int) + 1",
        "a grid with a row more finds the same",
    ),
    Explained(
        "jaxik/world/grid.py",
        "entry = jnp.where(step < count, start + step, 0)",
        "entry = jnp.where(step < count, start + step, -1)",
        "tests the last entry again instead of the first, which changes as little",
    ),
    Explained(
        "jaxik/world/grid.py",
        "plan = np.asarray(corners).reshape(-1, 3, 3)[..., :2]",
        "plan = np.asarray(corners).reshape(- 2, 3, 3)[..., :2]",
        "any negative number lets NumPy work out the length",
    ),
    Explained(
        "jaxik/world/grid.py",
        "longest = jnp.max(count, initial=0)",
        "longest = jnp.max(count, initial= -1)",
        "a loop of -1 steps is one of 0 steps",
    ),
    Explained(
        "jaxik/world/surfaces.py",
        "tolerance = 4 * jnp.finfo(distance.dtype).eps * jax.lax.stop_gradient(sum(parts))",
        "tolerance = 5 * jnp.finfo(distance.dtype).eps * jax.lax.stop_gradient(sum(parts))",
        ROUNDING,
    ),
    Explained(
        "jaxik/world/surfaces.py",
        "tolerance = 4 * jnp.finfo(distance.dtype).eps * jax.lax.stop_gradient(sum(parts))",
        "tolerance = 3 * jnp.finfo(distance.dtype).eps * jax.lax.stop_gradient(sum(parts))",
        ROUNDING,
    ),
]


def reason_for(path: str, before: str, after: str) -> str | None:
    """Why a mutant is as good as the original; None where a test should catch it."""
    return next((x.reason for x in EXPLAINED if x.matches(path, before, after)), None)
