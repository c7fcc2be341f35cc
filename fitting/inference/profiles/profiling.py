"""Finds the profiles of all parameters at once.

The whole range is scanned in batches. From the solution, each curve is then followed outwards in
both directions as long as the data allow, and its lowest points elsewhere descend, so that minima
are found. At last the ends of the intervals are refined. The best point that lies lower than the
solution goes back to the fit.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fitting.inference.optimise import checkpoints, evolution
from fitting.inference.optimise.checkpoints import StoredPoints, StoredProfiles
from fitting.inference.optimise.solution import Solution
from fitting.problem.problem import Problem
from fitting.problem.space import Space, from_fractions, to_fractions
from fitting.runtime import activity

from .conditional import Conditional, Points, Targets, join
from .profile import SAME_PLACE, Curves, crossing, low_parts

CLOSE = 6.0  # rise of the cost up to which another plateau may matter
GENERATIONS = 2  # of combinations of thresholds
CHILDREN = 64  # in a generation
PLATEAUS = 5  # from which descents begin, besides the solution's
SAME_PLATEAU = 0.01  # of the cost
SMALLEST = 0.01  # move of a threshold in a round, a fraction of the largest
SIZES = 6  # of these moves
VARIANTS = 64  # of a point, with other parameters moved
WIDENED = 0.5  # of their intervals, to either side
DEVIATIONS = np.array([-2.0, -1.0, 1.0, 2.0])  # by which smooth parameters move

GRID = np.concatenate([[0.001], (np.arange(20) + 0.5) / 20, [0.999]])  # fractions of the range
FOLLOWED = np.concatenate([GRID[:-1:2], GRID[-1:]])  # where curves are followed outwards
FINE_GRID = (np.arange(64) + 0.5) / 64  # for plateaus of thresholds
LOW = 40.0  # rise by the data up to which a curve is followed outwards
PROMISING = 400.0  # and up to which a minimum of the scan may become a minimum
MINIMA = 2  # of each curve from which descents begin
FREE_STEPS = 12  # of these descents, at most
ROUNDS = 8  # of refinement
SPANS = (1.0, 0.2, 0.04)  # of moves of thresholds, fractions of the range
CROSSINGS = 8  # rounds in which cliffs are crossed, at most
BEYOND = (0.0, 0.3, 1.0, 3.0)  # how far behind a cliff points are tried, in widths of the minimum
CLIFF = 1.5  # times the rise of a parabola: what lies behind the end of a minimum may be a cliff
NEARBY = 0.25  # widths of the minimum within which a cliff is sought
NEAR_PARABOLA = 0.35  # difference of square roots of rises that can be interpolated
NARROW = 0.05  # fraction of a minimum's width that its ends are found to


def other_plateaus(conditional: Conditional, curves: Curves) -> Points:
    """The best points on other plateaus of the thresholds, near in cost to the solution.

    The thresholds of children are drawn from those along the thresholds' curves, independently of
    each other.
    """
    space = conditional.problem.space
    thresholds = [int(i) for i in np.flatnonzero(space.thresholds)]
    random = np.random.default_rng(0)
    along = {i: curves.curves[i][curves.rises(i) < CLOSE] for i in thresholds}
    candidates = [along[i] for i in thresholds]
    for _ in range(GENERATIONS if len(thresholds) > 1 else 0):
        values = np.repeat(curves.best.values, CHILDREN, axis=0)
        for i in thresholds:
            values[:, i] = random.choice(along[i].values[:, i], CHILDREN)
        evaluated, gradient = conditional.evaluate(space.pack_values(values))
        here = Targets(np.full(len(values), thresholds[0]), values[:, thresholds[0]])
        everything = np.ones(evaluated.u.shape, bool)
        candidates += [conditional.points(conditional.move(evaluated, gradient, here, everything))]
    together = join(candidates)
    data_cost = together.cost - space.prior_costs(together.u)[:, thresholds].sum(axis=1)
    order = np.argsort(together.cost, kind="stable")
    order = order[together.cost[order] < curves.best.cost[0] + CLOSE]
    _, first = np.unique(np.round(data_cost[order] / SAME_PLATEAU), return_index=True)
    distinct = order[np.sort(first)][1 : PLATEAUS + 1]  # the first is the solution's own
    ends = conditional.descend_all([(u, None) for u in together.u[distinct]])
    if not ends:
        return together[:0]
    return conditional.points(np.asarray([u for u, _ in ends]))


def settle(
    conditional: Conditional,
    u: Float[np.ndarray, "targets free"],
    targets: Targets,
    spans: Sequence[float],
) -> Float[np.ndarray, "targets free"]:
    """Points at their targets with other parameters moved to where the cost is lowest.

    One parameter moves at a time: a threshold by distances of all sizes, a smooth one by some
    standard deviations. That crosses cliffs, and follows ridges, along which thresholds must move
    together. Each round begins at the best point so far; its span is the largest move of a
    threshold, as a fraction of the range.
    """
    space = conditional.problem.space
    for span in spans:
        base = space.values(u)
        single = [_single_moves(conditional, row, span) for row in u]
        candidates = np.concatenate(single)
        owner = np.repeat(np.arange(len(u)), [len(rows) for rows in single])
        values = space.values(candidates)
        rows = np.arange(len(owner))
        held = targets.index[owner]
        values[rows, held] = base[owner, held]
        candidates = space.pack_values(values)
        cost = evolution.evaluate(conditional.problem, candidates).cost
        best = [np.flatnonzero(owner == k)[np.argmin(cost[owner == k])] for k in range(len(u))]
        u = candidates[best]
    return u


def vary(conditional: Conditional, curves: Curves, start: Points, held: int) -> Points:
    """A point, and this point with one or two other parameters drawn from widened intervals."""
    space, random = conditional.problem.space, conditional.random
    values = np.repeat(start.values, VARIANTS, axis=0)
    order = np.argsort(random.random(values.shape), axis=1)
    drawn = order < random.integers(1, 3, (VARIANTS, 1))
    drawn[0] = False
    for i, parameter in enumerate(space.parameters):
        own = curves.fractions(i)
        low = own[curves.rises(i) <= curves.highest(i)]
        reach = WIDENED * (low[-1] - low[0])
        places = np.clip(random.uniform(low[0] - reach, low[-1] + reach, VARIANTS), 0, 1)
        chosen = drawn[:, i] & (i != held)
        values[chosen, i] = from_fractions(parameter, places[chosen])
    u = space.pack_values(values)
    return Points(u, values, np.full(VARIANTS, start.cost[0]))


def _single_moves(
    conditional: Conditional, u: Float[np.ndarray, " free"], span: float
) -> Float[np.ndarray, "moves free"]:
    """A point, and this point with one parameter moved."""
    space = conditional.problem.space
    present = space.values(u[None])[0]
    sizes = span * np.geomspace(SMALLEST, 1, SIZES)
    steps = np.concatenate([-sizes, sizes])
    moved_values, moved_u = [present[None]], []
    for j, parameter in enumerate(space.parameters):
        if parameter.kind == "threshold":
            places = np.clip(to_fractions(parameter, present[j]) + steps, 0, 1)
            values = np.tile(present, (len(steps), 1))
            values[:, j] = from_fractions(parameter, places)
            moved_values.append(values)
        else:
            sd = 1 / np.sqrt(conditional.gram[j, j])
            moved_u.append(u + np.outer(sd * DEVIATIONS, np.arange(space.size) == j))
    of_values = space.pack_values(np.concatenate(moved_values))
    return np.concatenate([of_values, *moved_u])


@dataclasses.dataclass
class Profiling:
    """The state of a profiling, to which its stages add."""

    conditional: Conditional
    solution: Points
    curves: Curves
    plateaus: Points
    cliffs: set[tuple[int, float]] = dataclasses.field(default_factory=set)
    """At which nothing is tried again: index of the parameter and fraction of its range."""
    crossed: bool = False
    """Whether no further cliff can be crossed."""
    stages: int = 0
    """Finished ones."""

    @classmethod
    def around(cls, problem: Problem, solution: Solution) -> "Profiling":
        """No profile yet, only the solution."""
        conditional = Conditional.around(problem, solution)
        start = conditional.points(np.asarray(solution.u)[None])
        return cls(conditional, start, Curves(problem, start), start[:0])

    @property
    def space(self) -> Space:
        """Of the free parameters."""
        return self.conditional.problem.space

    def stored(self) -> StoredProfiles:
        """All that stages change."""
        return {
            "stages": self.stages,
            "curves": [_stored_points(curve) for curve in self.curves.curves],
            "plateaus": _stored_points(self.plateaus),
            "cliffs": [[i, place] for i, place in sorted(self.cliffs)],
            "crossed": self.crossed,
            "random": dict(self.conditional.random.bit_generator.state),
        }

    def restore(self, stored: StoredProfiles) -> None:
        """Takes over what stages have changed.

        Raises:
            ValueError, TypeError, KeyError, OverflowError: it is not of these parameters.
        """
        size = self.space.size
        curves = [_points(points, size) for points in stored["curves"]]
        if len(curves) != size:
            raise ValueError(f"there are {len(curves)} profiles of {size} parameters")
        if not all(len(curve.cost) and np.isfinite(curve.cost).all() for curve in curves):
            raise ValueError("a profile has a point without a cost, or no point")
        plateaus = _points(stored["plateaus"], size)
        np.random.default_rng().bit_generator.state = stored["random"]  # raises for another state
        self.conditional.random.bit_generator.state = stored["random"]
        self.curves.curves, self.plateaus = curves, plateaus
        self.cliffs = {(int(i), place) for i, place in stored["cliffs"]}
        self.crossed, self.stages = stored["crossed"], stored["stages"]


def _stored_points(points: Points) -> StoredPoints:
    return {
        "u": points.u.tolist(),
        "values": points.values.tolist(),
        "cost": points.cost.tolist(),
    }


def _points(stored: StoredPoints, size: int) -> Points:
    """Points of a space of this size."""

    def array(rows: Sequence[Sequence[float]]) -> np.ndarray:
        return np.array(rows, np.float64).reshape(len(stored["cost"]), size)

    return Points(array(stored["u"]), array(stored["values"]), np.array(stored["cost"]))


def find_curves(problem: Problem, solution: Solution) -> Curves:
    """The profiles' points around a solution of a problem."""
    profiling, current = Profiling.around(problem, solution), checkpoints.current()
    store = current.recall_profiles(problem, np.asarray(solution.u), profiling.restore)
    try:
        title = f"Following {problem.space.size} parameters over their ranges"
        with activity.announced(title, len(STAGES)) as following:
            for stage in STAGES[profiling.stages :]:
                activity.note(stage.__name__.replace("_", " "))
                stage(profiling)
                profiling.stages += 1
                following.reach(profiling.stages)
                store(profiling.stored())
    finally:
        current.flush()
    return profiling.curves


def scan(profiling: Profiling) -> None:
    """Every parameter over its whole range, the others following by a Gauss-Newton step."""
    conditional, space = profiling.conditional, profiling.space
    index, value = [], []
    for i, parameter in enumerate(space.parameters):
        grid = FINE_GRID if parameter.kind == "threshold" else GRID
        index += [i] * len(grid)
        value += list(from_fractions(parameter, grid))
    targets = Targets(np.asarray(index), np.asarray(value))
    start = profiling.solution[np.zeros(len(index), int)]
    for following in (True, False):
        chosen = np.full(start.u.shape, following)
        moved = conditional.move(start, np.zeros_like(start.u), targets, chosen)
        profiling.curves.add(targets, conditional.points(moved))


def find_plateaus(profiling: Profiling) -> None:
    """Other plateaus of the thresholds, from which all later descents begin as well."""
    if any(profiling.space.thresholds):
        profiling.plateaus = other_plateaus(profiling.conditional, profiling.curves)


def follow_outwards(profiling: Profiling) -> None:
    """From the solution to either end of each range, as long as the data let the cost stay low."""
    space, curves = profiling.space, profiling.curves
    sides: list[tuple[int, Float[np.ndarray, " values"]]] = []
    for i, parameter in enumerate(space.parameters):
        present = to_fractions(parameter, profiling.solution.values[0, i])
        sides += [(i, FOLLOWED[FOLLOWED < present][::-1]), (i, FOLLOWED[FOLLOWED > present])]
    last = [profiling.solution] * len(sides)
    active, position = [s for s in range(len(sides)) if len(sides[s][1])], 0
    while active:
        index = np.asarray([sides[s][0] for s in active])
        places = [sides[s][1][position] for s in active]
        targets = targets_at(profiling, index, places)
        starts = [
            join([last[s], curves.nearest(i, p)])
            for s, i, p in zip(active, index, places, strict=True)
        ]
        points = lowest(profiling, targets, starts, settling=True)
        curves.add(targets, points)
        following = []
        for k, (s, i) in enumerate(zip(active, index, strict=True)):
            last[s] = points[k : k + 1]
            u = np.concatenate([last[s].u, profiling.solution.u])
            own = curves.problem.prior_costs(u)[:, i]
            rise = points.cost[k] - own[0] - (curves.best.cost[0] - own[1])
            if rise < LOW and position + 1 < len(sides[s][1]):
                following.append(s)
        active, position = following, position + 1


def descend_elsewhere(profiling: Profiling) -> None:
    """From the lowest minima of each curve outside the minima, with no parameter held."""
    curves, conditional = profiling.curves, profiling.conditional
    for i, curve in enumerate(curves.curves):
        rises = curves.data_rises(i)
        padded = np.concatenate([[np.inf], rises, [np.inf]])
        minimum = (rises <= padded[:-2]) & (rises < padded[2:])
        outside = (rises > curves.highest(i)) & (rises < PROMISING)
        minima = np.flatnonzero(minimum & outside)
        minima = minima[np.argsort(rises[minima], kind="stable")[:MINIMA]]
        if len(minima):
            starts = [(u, None) for u in curve.u[minima]]
            ends = conditional.descend_all(starts, FREE_STEPS)
            points = conditional.points(np.asarray([u for u, _ in ends]))
            curves.add(Targets(np.full(len(minima), i), points.values[:, i]), points)


def refine(profiling: Profiling) -> None:
    """New points where minima end and between minima, until the ends are known well enough."""
    curves, tried = profiling.curves, set()
    for number in range(ROUNDS):
        index, places, starts = [], [], []
        for i, curve in enumerate(curves.curves):
            for inside, outside in open_ends(curves, i):
                index.append(i)
                places.append(_next_place(curves, i, inside, outside, bisect=number % 3 == 2))
                starts.append(curve[np.asarray([inside, outside])])
            for k in barrier(curves, i):
                if (i, place := float(curves.fractions(i)[k])) not in tried:
                    tried.add((i, place))
                    index.append(i)
                    places.append(place)
                    starts.append(curve[np.asarray([k - 1, k + 1])])
        if not index:
            return
        targets = targets_at(profiling, np.asarray(index), places)
        curves.add(targets, lowest(profiling, targets, starts))


def share(profiling: Profiling) -> None:
    """Every curve gets the points of the others that lie below it."""
    profiling.curves.share()
    refine(profiling)


def cross(profiling: Profiling) -> None:
    """Continues beyond cliffs, unless there was nothing to cross in the round before."""
    if not profiling.crossed and cross_cliffs(profiling):
        refine(profiling)
    else:
        profiling.crossed = True


def cross_cliffs(profiling: Profiling) -> bool:
    """Tries to continue beyond cliffs that end a minimum; whether any was crossed.

    Behind a cliff another decision holds, so other parameters must move together with this one:
    they are drawn anew within their own intervals and a little beyond.
    """
    curves, conditional, space = profiling.curves, profiling.conditional, profiling.space
    tried = profiling.cliffs
    index: list[int] = []
    places: list[float] = []
    starts: list[Points] = []
    for i in range(space.size):
        rises, own, highest = curves.rises(i), curves.fractions(i), curves.highest(i)
        for part in low_parts(own, rises, highest):
            width = float(own[part.stop - 1] - own[part.start])
            for inside, outside in ((part.start, part.start - 1), (part.stop - 1, part.stop)):
                cliff = is_cliff(own, rises / highest, outside, width)
                if cliff and (place := (i, float(own[inside]))) not in tried:
                    tried.add(place)
                    distance = np.sign(outside - inside) * width * np.asarray(BEYOND)
                    beyond = own[outside] + distance
                    beyond = beyond[(beyond >= 0) & (beyond <= 1)]
                    index += [i] * len(beyond)
                    places += list(beyond)
                    starts += [curves.curves[i][inside : inside + 1]] * len(beyond)
    if not index:
        return False
    targets = targets_at(profiling, np.asarray(index), places)
    variants = [vary(conditional, curves, start, i) for i, start in zip(index, starts, strict=True)]
    points = conditional.lowest(targets, variants)
    curves.add(targets, points)
    levels = np.asarray([curves.highest(i) for i in index])
    return bool((points.cost - curves.best.cost[0] < levels).any())


def is_cliff(places: np.ndarray, rises: np.ndarray, outside: int, width: float) -> bool:
    """Whether a curve rises much faster than a parabola outside a minimum.

    Args:
        places: fractions of the range.
        rises: there, in units of the rise at the minimum's ends.
        outside: index of the first point outside.
        width: of the minimum, a fraction of the range.
    """
    if not 0 <= outside < len(places):
        return False
    distance = np.abs(places - places[outside])
    further = (rises > 1) & (distance <= NEARBY * width)
    parabola = (1 + 2 * distance[further] / max(width, SAME_PLACE)) ** 2
    return bool((rises[further] > CLIFF * parabola).any())


def targets_at(profiling: Profiling, index: np.ndarray, places: Sequence[float]) -> Targets:
    """Targets at fractions of the parameters' ranges."""
    parameters = [profiling.space.parameters[i] for i in index]
    values = [
        from_fractions(parameter, np.asarray(place))
        for parameter, place in zip(parameters, places, strict=True)
    ]
    return Targets(index, np.asarray(values))


def lowest(
    profiling: Profiling, targets: Targets, starts: list[Points], *, settling: bool = False
) -> Points:
    """The lowest points at the targets, from these starts and from the other plateaus.

    When `settling`, where a threshold is held and the cost is not low, other thresholds may move.
    """
    conditional, space, curves = profiling.conditional, profiling.space, profiling.curves
    starts = [join([near, profiling.plateaus]) for near in starts]
    points = conditional.lowest(targets, starts)
    if not settling or sum(space.thresholds) < 2:
        return points
    rises = points.cost - curves.best.cost[0]
    highest = np.asarray([curves.highest(i) for i in targets.index])
    stuck = (rises > highest) & (rises < PROMISING)
    stuck = np.flatnonzero(stuck & np.asarray(space.thresholds)[targets.index])
    if not len(stuck):
        return points
    settled = conditional.points(settle(conditional, points.u[stuck], targets[stuck], SPANS))
    moved = conditional.lowest(targets[stuck], [settled[k : k + 1] for k in range(len(stuck))])
    lower = moved.cost < points.cost[stuck]
    order = np.arange(len(points.cost))
    order[stuck[lower]] = len(order) + np.flatnonzero(lower)
    return join([points, moved])[order]


def open_ends(curves: Curves, i: int) -> list[tuple[int, int]]:
    """Indices of the points inside and outside each end that is not known well enough."""
    rises, own, ends = curves.rises(i), curves.fractions(i), []
    smooth = curves.space.smooth[i]
    for part in low_parts(own, rises, curves.highest(i)):
        last = part.stop - 1
        width = own[min(part.stop, len(own) - 1)] - own[max(part.start - 1, 0)]
        for inside, outside in ((part.start, part.start - 1), (last, last + 1)):
            if not 0 <= outside < len(own):
                continue
            gap = np.sqrt(rises[outside]) - np.sqrt(rises[inside])
            narrow = abs(own[outside] - own[inside]) < NARROW * width
            if not narrow and not (smooth and gap < NEAR_PARABOLA):
                ends.append((inside, outside))
    return ends


def barrier(curves: Curves, i: int) -> list[int]:
    """Indices of the points between two minima."""
    parts = low_parts(curves.fractions(i), curves.rises(i), curves.highest(i))
    return [k for a, b in zip(parts[:-1], parts[1:], strict=True) for k in range(a.stop, b.start)]


def _next_place(curves: Curves, i: int, inside: int, outside: int, *, bisect: bool) -> float:
    """Fraction of the range to try between two points."""
    rises, own = curves.rises(i), curves.fractions(i)
    middle = 0.5 * (own[inside] + own[outside])
    if bisect or not curves.space.smooth[i]:
        return float(middle)
    place = crossing(
        (own[inside], rises[inside]), (own[outside], rises[outside]), curves.highest(i)
    )
    low, high = (own[inside] + share * (own[outside] - own[inside]) for share in (0.02, 0.98))
    return float(np.clip(place, min(low, high), max(low, high)))


STAGES = (
    scan,
    find_plateaus,
    follow_outwards,
    descend_elsewhere,
    refine,
    share,
    *(cross for _ in range(CROSSINGS)),
)
