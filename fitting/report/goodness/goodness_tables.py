"""Tables of the goodness of fit, a row for each kind of residual in each clip."""

from collections.abc import Sequence

from fitting.analysis.goodness.distances import CLOSE, MOTIONS, Distances
from fitting.analysis.goodness.groups import Group
from fitting.analysis.goodness.verdict import NAMES, PARTS, SMALL, size
from fitting.report.formatting import Table, number, percent
from fitting.report.labels import RESIDUALS


def size_table(groups: Sequence[Group], *, judged: bool = True) -> Table:
    """How large the residuals are, and with how many they are judged.

    Args:
        groups: the rows.
        judged: False leaves out p, which says nothing where sigmas are not those of the noise.
    """
    heading = ["residuals", "active", "degrees of freedom", "reduced chi-square", "p"]
    table = [[*heading, "sigma", "noise", "noise / sigma"]]
    for group in groups:
        cells = [RESIDUALS[group.kind].name, str(group.left.count), f"{group.left.degrees:.0f}"]
        p = _p(group.left.p, group) if judged else "–"
        cells += [number(group.left.mean_square), p, *_sizes(group)]
        table.append(cells)
    return _with_clips(table, groups)


def distance_table(distances: Distances) -> Table:
    """How far motions are from the captured one, on fitted frames and on those held out."""
    table = [["distance from the capture, rms", "frames", "flat animation", "before", "fitted"]]
    for part, motions in distances.parts.items():
        for kind in CLOSE:
            cells = [size(kind, motions[motion][kind]) for motion in MOTIONS]
            table.append([NAMES[kind], PARTS[part].removesuffix(" frames"), *cells])
    return table


def distances_of_preset(distances: Distances) -> Table:
    """How far a system that nobody has fitted yet leaves the captured motion."""
    table = [["distance from the capture, rms", "flat animation", "preset"]]
    motions = distances.parts.get("fitted", {})
    for kind in CLOSE if motions else ():
        sizes = [size(kind, motions[motion][kind]) for motion in ("animation", "before")]
        table.append([NAMES[kind], *sizes])
    return table


def tolerance_table(groups: Sequence[Group]) -> Table:
    """How large the errors are where there is no noise."""
    table = [["residuals", "active", "tolerance", "error, rms", "error / tolerance"]]
    for group in groups:
        table.append([RESIDUALS[group.kind].name, str(group.plain.count), *_sizes(group)])
    return _with_clips(table, groups)


def noise_table(groups: Sequence[Group]) -> Table:
    """Whether the residuals look like noise."""
    measured = [group for group in groups if group.is_measured]
    heading = ["residuals", "correlation given", "found", "left", "p", "independent every"]
    table = [[*heading, "swing / stance", "p", "beyond 3", "beyond 5"]]
    for group in measured:
        left, ratio = group.left, group.swing_ratio
        cells = [RESIDUALS[group.kind].name, f"{group.correlation:.2f}"]
        cells += [f"{group.plain.autocorrelation:.3f}", f"{left.autocorrelation:.3f}"]
        cells += [_p(left.autocorrelation_p, group), f"{left.spacing * group.dt:.3g} s"]
        cells += ["–", "–"] if ratio is None else [f"{ratio:.2f}", _p(group.swing_p, group)]
        cells += [percent(group.near, 2), percent(group.far, 2)]
        table.append(cells)
    return _with_clips(table, measured)


def _sizes(group: Group) -> list[str]:
    """The given sigma, the size of the errors, and their ratio."""
    _, unit, factor = RESIDUALS[group.kind]
    sizes = (group.sigma, group.sigma * group.plain.scale)
    return [*(f"{number(factor * size)} {unit}" for size in sizes), f"{group.plain.scale:.2f}"]


def _with_clips(table: Table, groups: Sequence[Group]) -> Table:
    """The table with a column for the clip, where there are several."""
    if not any(group.clip for group in groups):
        return table
    heading, *rows = table
    numbered = zip(groups, rows, strict=True)
    return [["clip", *heading], *([str(group.clip + 1), *row] for group, row in numbered)]


def _p(value: float, group: Group) -> str:
    if not group.is_measured:
        return "–"
    return f"< {SMALL:.4f}" if value < SMALL else f"{value:.4f}"
