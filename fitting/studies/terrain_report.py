"""Ground reconstructed from a clip: the job, and its files (mesh, numbers, picture)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from fitting.clips import Clip, load_clip
from fitting.clips.load import AS_FOUND, ClipOptions
from fitting.ground import meshes
from fitting.ground.reconstruction import (
    SURFACE_KINDS,
    LevelBlocks,
    Plane,
    Prediction,
    Reconstruction,
    Surface,
    ThinPlate,
    reconstruct,
)
from fitting.report import style
from fitting.report.document import Document, Finding, Grid, Plot, Section, Text, text
from fitting.report.formatting import Table, interval, joined
from fitting.report.style import BEFORE, GROUND, STAGES, area_key, legend, line_key, styled
from fitting.runtime import activity, files
from fitting.runtime.precision import in_float64

NUMBERS, FIGURE = ".json", ".png"  # beside the mesh, under its name

COLOURS: dict[str, str] = dict(zip(SURFACE_KINDS, (STAGES[1], STAGES[2], STAGES[0]), strict=True))
SCATTER = 0.03  # m, of soles above the ground, from which on the two do not belong together
PIXELS = 300  # along the longer side of the plan
LEGS = "o^sDvP*X"  # marks of the legs


@in_float64
def reconstruct_terrain(
    clip: str | Path,
    output: str | Path,
    *,
    model: str | None = None,
    margin: float = 1.0,
    options: ClipOptions = AS_FOUND,
) -> Reconstruction:
    """Reconstructs the ground of a captured clip from its stances, and writes it as a mesh.

    Args:
        clip: the file of the clip.
        output: .ply, .obj or .stl file; all numbers and a picture go beside it, under its name.
        model: which of `SURFACE_KINDS` is written; None chooses by the error of prediction.
        margin: how far the mesh extends beyond the stances, m.
        options: how the clip is read.

    Raises:
        ValueError: the clip cannot be read or has too few stances, a file cannot be written, or
            there is no such model.
    """
    path, mesh = Path(clip), Path(output)
    meshes.check_mesh_name(mesh)
    for file in output_files(mesh):
        files.check_output_file(file)
    with activity.announced(f"Reading {path.name}"):
        captured = load_clip(path, **options.given)
    with activity.announced(f"Reconstructing the ground of {path.name}"):
        terrain = reconstruct(captured, kind=model)
    with activity.announced("Drawing and writing the ground"):
        report = write(mesh, terrain, captured, margin)
    notes = (f"note: {remark}" for remark in captured.remarks)
    activity.log(joined([text(report), *notes, "", f"written to {mesh}"]))
    return terrain


def output_files(mesh: Path) -> tuple[Path, Path, Path]:
    """The files that `write` writes."""
    return mesh, mesh.with_suffix(NUMBERS), mesh.with_suffix(FIGURE)


def write(mesh: Path, terrain: Reconstruction, clip: Clip, margin: float) -> Document:
    """Writes the chosen surface as a mesh, and beside it the numbers and a picture.

    Args:
        mesh: output file, .ply, .obj or .stl.
        terrain: what was reconstructed.
        clip: from which it was.
        margin: how far the mesh extends beyond the stances, m.
    """
    report = document(mesh, terrain, clip)
    figure = plan(terrain, margin, clip.rig.names, title_of(terrain, clip))
    style.save(mesh.with_suffix(FIGURE), figure)  # first, as it takes longest and may fail
    report.write(mesh.parent)
    surface = terrain.surface.mesh(*terrain.extent(margin))
    files.write(mesh, lambda temporary: meshes.save_mesh(temporary, *surface))
    return report


def title_of(terrain: Reconstruction, clip: Clip) -> str:
    """Of the picture."""
    return f"Ground of {clip.source}: {describe_surface(terrain)}"


def document(mesh: Path, terrain: Reconstruction, clip: Clip) -> Document:
    """The report of a reconstruction, whose picture is drawn already; arguments as for `write`."""
    surface = describe_surface(terrain)
    error = terrain.predictions[terrain.chosen].rms
    return Document(
        file="",
        kind="Ground reconstructed from motion",
        title=clip.source,
        verdict=terrain.chosen.capitalize(),
        good=error < SCATTER,
        findings=[Finding(f"{surface[0].upper()}{surface[1:]}.")],
        sections=[
            Section(
                "How well stances are predicted",
                [
                    Text(count_stances(terrain), brief=True),
                    Grid(prediction_table(terrain), "Errors of prediction"),
                    Plot(mesh.with_suffix(FIGURE).name, title_of(terrain, clip)),
                ],
            )
        ],
        setup=[["Clip", clip.source]],
        numbers={mesh.with_suffix(NUMBERS).name: numbers(terrain, clip)},
    )


def prediction_table(terrain: Reconstruction) -> Table:
    """How well each kind of surface predicts a stance from the others."""
    table = [["ground", "error, cm rms", "median", "alone on a block", "error without those"]]
    for kind in SURFACE_KINDS:
        prediction = terrain.predictions[kind]
        alone, count = int(prediction.alone.sum()), len(prediction.errors)
        median = np.median(np.abs(prediction.errors))
        name = f"{kind} (chosen)" if kind == terrain.chosen else kind
        alone_cell = f"{alone} of {count}" if kind == "blocks" else ""
        shared_cell = f"{100 * prediction.rms_shared:.2f}" if 0 < alone < count else ""
        cells = [name, f"{100 * prediction.rms:.2f}", f"{100 * median:.2f}"]
        table.append([*cells, alone_cell, shared_cell])
    return table


def count_stances(terrain: Reconstruction) -> str:
    """How many stances there are, and how many on toes were used."""
    stances = terrain.stances
    text = f"{len(stances.leg)} stances"
    if stances.toes.any():
        used = int((stances.toes & stances.used).sum())
        text += f"; {int(stances.toes.sum())} on toes, {used} of them used"
    if not (stances.used | stances.toes).all():
        text += f"; surfaces are fitted to {int(stances.used.sum())} of all, evenly chosen"
    return text


def describe_surface(terrain: Reconstruction) -> str:
    """The chosen surface in words."""
    surface, grids = terrain.surface, terrain.grids
    match surface:
        case LevelBlocks():
            grid, count = surface.grid, len(surface.tops)
            pitches = interval(*np.round(grids.pitches, 2))
            low, high = np.degrees(grids.headings)
            return (
                f"level blocks of {grid.pitch:.2f} m ({pitches} m are about as likely), rotated by "
                f"{np.degrees(grid.heading):.1f}° ({low:.1f}° to {high:.1f}°), {count} of them "
                "visited"
            )
        case Plane():
            return f"a plane that rises by {np.degrees(np.arctan(np.hypot(*surface.slope))):.2f}°"
        case ThinPlate():
            low, high = 100 * surface.lowest, 100 * surface.highest
            return f"a smooth surface from {low:.1f} to {high:.1f} cm"
        case _:
            raise TypeError(f"no description for {surface}")


def numbers(terrain: Reconstruction, clip: Clip) -> dict[str, object]:
    """What the JSON file holds: metres, radians, frames; null where a value is unknown."""
    return {
        "clip": clip.source,
        "frames": clip.frame_count,
        "fps": clip.fps,
        "ball_over_sole": _rounded(terrain.sole),
        "chosen": terrain.chosen,
        "tested": {
            kind: {
                "rms": _rounded(prediction.rms),
                "median": _rounded(float(np.median(np.abs(prediction.errors)))),
                "stances": len(prediction.errors),
                "alone": int(prediction.alone.sum()),
                "rms_without_alone": _rounded(prediction.rms_shared),
            }
            for kind, prediction in terrain.predictions.items()
        },
        "grounds": {
            kind: _surface_numbers(terrain.surfaces[kind], terrain) for kind in SURFACE_KINDS
        },
        "stances": _stance_numbers(terrain, clip),
    }


def _stance_numbers(terrain: Reconstruction, clip: Clip) -> list[dict[str, object]]:
    stances, used_index = terrain.stances, np.cumsum(terrain.stances.used) - 1
    rows = []
    for i in range(len(stances.leg)):
        row: dict[str, object] = {
            "leg": clip.rig.names[stances.leg[i]],
            "first_frame": int(stances.first[i]),
            "last_frame": int(stances.last[i]),
            "x": _rounded(stances.points[i, 0]),
            "z": _rounded(stances.points[i, 1]),
            "height": _rounded(stances.heights[i]),
            "on_toes": bool(stances.toes[i]),
            "used": bool(stances.used[i]),
        }
        if stances.used[i]:
            predictions, index = terrain.predictions, used_index[i]
            row["errors"] = {
                kind: _rounded(float(prediction.errors[index]))
                for kind, prediction in predictions.items()
            }
            row["alone"] = bool(predictions["blocks"].alone[index])
        rows.append(row)
    return rows


def _surface_numbers(surface: Surface, terrain: Reconstruction) -> dict[str, object]:
    match surface:
        case LevelBlocks():
            return {
                "pitch": _rounded(surface.grid.pitch),
                "pitches_about_as_likely": [_rounded(pitch) for pitch in terrain.grids.pitches],
                "heading": _rounded(surface.grid.heading),
                "headings_about_as_likely": [_rounded(angle) for angle in terrain.grids.headings],
                "origin": [_rounded(coordinate) for coordinate in surface.grid.origin],
                "cell_of": "u = cos(heading) x + sin(heading) z, v = -sin(heading) x + "
                "cos(heading) z; i = floor((u - origin[0]) / pitch), j likewise of v",
                "blocks": [
                    {"i": int(i), "j": int(j), "height": _rounded(top), "stances": int(count)}
                    for (i, j), top, count in zip(
                        surface.cells, surface.tops, surface.stances, strict=True
                    )
                ],
            }
        case Plane():
            return {
                "level_at_origin": _rounded(surface.level),
                "slope": [_rounded(component) for component in surface.slope],
            }
        case ThinPlate():
            return {"smoothing": surface.smoothing}
        case _:
            raise TypeError(f"no numbers for {surface}")


def _rounded(value: float) -> float | None:
    """To a tenth of a millimetre; None for NaN."""
    return None if np.isnan(value) else round(float(value), 4) + 0.0


@styled
def plan(terrain: Reconstruction, margin: float, legs: tuple[str, ...], title: str) -> Figure:
    """The chosen surface from above with its stances, and how well each kind predicts them."""
    figure = Figure(figsize=(17, 9.5), layout="constrained")
    figure.suptitle(title)
    ((left, right),) = figure.subfigures(1, 2, squeeze=False, width_ratios=[1.15, 1.0])
    _draw_plan(left.subplots(), terrain, margin, legs)
    (upper,), (lower,) = right.subplots(2, 1, squeeze=False)
    _draw_errors(upper, terrain.predictions)
    _draw_fractions(lower, terrain.predictions)
    marks = [
        line_key(leg, marker=mark, linestyle="", markerfacecolor="white")
        for leg, mark in zip(legs, _marks(len(legs)), strict=True)
    ]
    entries: list[Artist] = [*marks]
    if not terrain.stances.used.all():
        entries.append(line_key("not used", marker="x", linestyle=""))
    if isinstance(terrain.surface, LevelBlocks):
        entries.append(area_key("not visited", "white", edgecolor=BEFORE, hatch="///"))
    entries += [
        line_key(f"predicted by {kind}", COLOURS[kind], linewidth=3) for kind in SURFACE_KINDS
    ]
    legend(figure, *entries, columns=7)
    return figure


def _draw_plan(axes: Axes, terrain: Reconstruction, margin: float, legs: tuple[str, ...]) -> None:
    """Heights as colours, edges of blocks, and stances coloured by their measured height."""
    low, high = terrain.extent(margin)
    count = np.ceil(PIXELS * (high - low) / np.max(high - low)).astype(int)
    x, z = (np.linspace(*part) for part in zip(low, high, count, strict=True))
    points = np.stack(np.meshgrid(x, z), axis=-1)
    heights = 100 * terrain.surface.heights(points.reshape(-1, 2)).reshape(points.shape[:2])
    stances = terrain.stances
    measured = 100 * stances.heights
    visible = np.concatenate([heights.ravel(), measured[stances.used]])
    lowest, highest = visible.min(), max(visible.max(), visible.min() + 1.0)
    colours = {"vmin": lowest, "vmax": highest, "cmap": "viridis"}
    image = axes.pcolormesh(x, z, heights, shading="nearest", rasterized=True, **colours)
    axes.figure.colorbar(image, ax=axes, label="height, cm", shrink=0.8)
    axes.grid(False)
    if isinstance(terrain.surface, LevelBlocks):
        _draw_blocks(axes, terrain.surface, points)
    for leg, mark in zip(range(len(legs)), _marks(len(legs)), strict=True):
        of_leg = (stances.leg == leg) & stances.used
        axes.scatter(
            *stances.points[of_leg].T, c=measured[of_leg], marker=mark, s=70, edgecolors="white",
            linewidths=1.4, **colours,
        )  # fmt: skip
    axes.plot(*stances.points[~stances.used].T, "x", color="white", markersize=7)
    axes.set_aspect("equal")
    axes.set_xlim(high[0], low[0])  # seen from above with z up, x points left
    axes.set_ylim(low[1], high[1])
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    axes.set_title(
        f"{terrain.chosen.capitalize()} from above, with the\nheight measured at each stance"
    )


def _draw_blocks(axes: Axes, blocks: LevelBlocks, points: np.ndarray) -> None:
    """Edges of blocks, and hatching over those that nobody stepped on."""
    cells = blocks.grid.cells(points.reshape(-1, 2))
    low, high = cells.min(axis=0), cells.max(axis=0) + 1
    lines = [[(i, low[1]), (i, high[1])] for i in range(low[0], high[0] + 1)]
    lines += [[(low[0], j), (high[0], j)] for j in range(low[1], high[1] + 1)]
    edges = blocks.grid.points(np.array(lines, np.float64))
    axes.add_collection(LineCollection(list(edges), colors=GROUND, linewidths=1.0))
    visited = blocks.supported(points.reshape(-1, 2)).reshape(points.shape[:2])
    axes.contourf(
        points[0, :, 0], points[:, 0, 1], ~visited, levels=[0.5, 1.5], colors="none", hatches=["//"]
    )


def _draw_errors(axes: Axes, predictions: Mapping[str, Prediction]) -> None:
    """The error of every stance, in order of time."""
    for kind, prediction in predictions.items():
        number, errors = np.arange(1, len(prediction.errors) + 1), 100 * prediction.errors
        colour, alone = COLOURS[kind], prediction.alone
        axes.plot(number, errors, color=colour, linewidth=1.0, alpha=0.5)
        axes.plot(number, errors, "o", color=colour, markersize=4)
        ring = {"color": colour, "markersize": 9, "fillstyle": "none"}
        axes.plot(number[alone], errors[alone], "o", **ring)
    axes.axhline(0.0, color="black", linewidth=0.8)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("stance, in order of time")
    axes.set_ylabel("error, cm")
    axes.set_title("Predicted from the other stances (ringed: no other stance on its block)")


def _draw_fractions(axes: Axes, predictions: Mapping[str, Prediction]) -> None:
    """Fraction of the stances that are predicted within an error."""
    largest = max(np.abs(prediction.errors).max() for prediction in predictions.values())
    for kind, prediction in predictions.items():
        size = np.sort(np.abs(prediction.errors))
        fraction = np.arange(len(size) + 1) / len(size)
        across = 100 * np.concatenate([[0.0], size, [1.05 * largest]])
        axes.step(across, 100 * np.append(fraction, 1.0), where="post", color=COLOURS[kind])
    axes.set_xlim(0.0, 105 * largest)
    axes.set_ylim(0.0, 102.0)
    axes.set_xlabel("size of the error, cm")
    axes.set_ylabel("stances within this error, %")
    rms = ", ".join(
        f"{kind} {100 * prediction.rms:.1f}" for kind, prediction in predictions.items()
    )
    axes.set_title(f"Stances within an error (rms: {rms} cm)")


def _marks(count: int) -> str:
    return (LEGS * count)[:count]
