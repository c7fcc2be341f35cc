"""Mutants that no test can catch or should, with the reason: they are not run and not counted."""

from typing import NamedTuple


class Explained(NamedTuple):
    """A mutant, or several of one kind, and why it is as good as the original."""

    path: str
    before: str  # the part of a line that changes
    after: str  # what it becomes; empty for any change of the line
    reason: str

    def matches(self, path: str, before: str, after: str) -> bool:
        """Whether this entry is about a mutant of that module, with the line before and after."""
        if path != self.path or self.before not in before:
            return False
        return not self.after or before.replace(self.before, self.after) == after


STAND_IN = "stands in where its result is not used, so that no derivative becomes NaN"
SPEED = "changes time or memory, no result"
GUARD = "guards against a mistake of the caller, which none makes"
BOUNDARY = "both sides are equal at the boundary"
ROUNDING = "a few more or less roundings are as good"
LOOK = "changes how a picture looks, which the eye judges"
NO_SIGN = "any negative number lets NumPy work out the length"
REASONS = {
    "fitting/studies/calibrate/calibration.py": [("line_key(", "", LOOK)],
    "fitting/studies/fit/fit_plots.py": [("(-5.0, 5.0, 41)", "(-5.0, 5.0, 40)", LOOK)],
    "fitting/studies/population.py": [("columns=5", "columns= 4", LOOK)],
    "fitting/bench/baselines.py": [
        ("(flat_ankle, axis=-1)", "(flat_ankle, axis=1)", "there are two axes")
    ],
    "fitting/bench/report.py": [("width=6.2", "width= 7.2", LOOK)],
    "fitting/cli/drawing.py": [
        ("default=0", "default= 1", "the longest word counts only where it is long")
    ],
    "fitting/clips/formats/gltf_writer.py": [("GREY = [", "", LOOK)],
    "fitting/motion/flat_animation.py": [
        ("(joints, after, strict=True", "(joints, after, strict=False", GUARD)
    ],
    "fitting/synthetic/footsteps.py": [
        ("landed[1:] & landed", "landed[1:] | landed", "as a foot lifts or lands, nothing changes")
    ],
    "fitting/ground/reconstruction.py": [
        ("LATTICE = (-3", "LATTICE = (- 2", "grids within the same range are as good")
    ],
    "fitting/ground/meshes.py": [
        ("hits: bool = True", "hits: bool = False", "a protocol's default is never taken")
    ],
    "fitting/inference/sensitivity.py": [
        ("scenes, u), strict=True", "scenes, u), strict=False", GUARD)
    ],
    "fitting/inference/noise.py": [
        ("ITERATIONS = 100", f"ITERATIONS = {number}", "the last reweighting changes nothing")
        for number in (99, 101)
    ],
    "fitting/viewer/solving.py": [("(230, 159, 0)", "", LOOK)],
    "fitting/studies/draft.py": [
        ("rig = data[0]", "rig = data[ -1]", "either clip has a body to start from")
    ],
    "fitting/studies/calibrate/replicates.py": [
        ("noise_factor: float = 1.0", "", "the calibration always says which")
    ],
    "fitting/inference/optimise/checkpoints.py": [("(before.best, before.point)", "[]", SPEED)],
    "fitting/inference/profiles/conditional.py": [
        ("CANDIDATES = 12", f"CANDIDATES = {number}", "a random candidate more or less is as good")
        for number in (11, 13)
    ],
    "fitting/inference/profiles/profiling.py": [
        ("GENERATIONS = 2", "GENERATIONS = 3", "more random combinations are as good")
    ],
    "fitting/inference/sample/sampler.py": [
        ("length // 2", "length // 3", "two thirds of a chain teach as much as its last half")
    ],
    "jaxik/solvers/two_bone.py": [
        ("tiny**0.5", "tiny** 1.5", "nearer to the pole than 1e-8, rounding decides"),
        (".eps ** 2", ".eps ** 3", "a distance of 1e-16 m or 1e-24 m is nothing either way"),
        ("has_room, room, 1.0", "has_room, room, 2.0", STAND_IN),
    ],
    "jaxik/batching/lanes.py": [("@jax.checkpoint", "", SPEED)],
    "jaxik/batching/primitives.py": [("UNROLLED_SUM = 8", "", SPEED)],
    "jaxik/maths/gate.py": [
        ("(jnp.where(infinite, 0.0, gap)", f"(jnp.where(infinite, {number}, gap)", STAND_IN)
        for number in ("1.0", "-1.0")
    ],
    "jaxik/maths/struct.py": [
        ("*static_values), strict=True", "*static_values), strict=False", GUARD)
    ],
    "jaxik/maths/vec.py": [("known, square, 1.0", "known, square, 2.0", STAND_IN)],
    "jaxik/maths/parameter_tree.py": [
        ('"per_leg", True', '"per_leg", False', "all owners are rules, which have one")
    ],
    "jaxik/pipeline/simulation.py": [
        ("count, rig.side.shape[0]", "count, rig.side.shape[ -1]", "there is one axis")
    ],
    "jaxik/stages/fade.py": [
        ("beyond, distance, 1.0", "beyond, distance, 2.0", STAND_IN),
        ("(behind, gap, 1.0), 0.0)", "(behind, gap, 1.0), 1.0)", STAND_IN),
    ],
    "jaxik/stages/pelvis.py": [
        ("goal - state.height", "goal + state.height", "only tells whether to jump, by 0.1 mm")
    ],
    "jaxik/stages/probe/stride.py": [
        ("away > self.max_step_up", "away >= self.max_step_up", BOUNDARY)
    ],
    "jaxik/stages/probe/base.py": [
        (
            "(above > 0, above, 0.0)",
            "(above > 0, above, -1.0)",
            "what a ray from further up hits besides does not lie below what the first ray hits",
        )
    ],
    "jaxik/stages/target.py": [
        ("started, climb, 0.0", "started, climb, -1.0", "at first heights jump to their goals")
    ],
    "jaxik/world/cells.py": [
        ("SPLIT = 4", "SPLIT = 3", SPEED),
        (
            "+ pad - corner) / pitch).astype(int), 0",
            "+ pad - corner) / pitch).astype(int), -1",
            "the grid begins below all corners",
        ),
        ("pitch + 0.37", "pitch + 1.37", "a grid with a row more finds the same"),
        ("first_parts[level.cell] < 0", "first_parts[level.cell] <= 0", "no part has the number 0"),
    ],
    "jaxik/world/frame.py": [
        ("zeros_like(points_ws[..., 0]", "zeros_like(points_ws[..., 1]", "both have one shape")
    ],
    "jaxik/world/grid.py": [
        ("start + step, 0)", "start + step, -1)", "tests the last entry again, not the first"),
        ("reshape(-1, 3, 3)[..., :2]", "reshape(- 2, 3, 3)[..., :2]", NO_SIGN),
        ("initial=0", "initial= -1", "a loop of -1 steps is one of 0 steps"),
    ],
    "jaxik/world/surfaces.py": [
        ("tolerance = 4", f"tolerance = {number}", ROUNDING) for number in (3, 5)
    ],
}
EXPLAINED = [Explained(path, *entry) for path, entries in REASONS.items() for entry in entries]


def reason_for(path: str, before: str, after: str) -> str | None:
    """Why a mutant is as good as the original; None where a test should catch it."""
    return next((x.reason for x in EXPLAINED if x.matches(path, before, after)), None)
