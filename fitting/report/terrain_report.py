"""The files of a terrain reconstructed from motion (mesh, numbers, picture), and its text."""

import json
from pathlib import Path

import numpy as np

from fitting.datasets.clips.clip import Clip
from fitting.datasets.terrain import mesh_files
from fitting.datasets.terrain.reconstruction import SURFACE_KINDS, Reconstruction
from fitting.datasets.terrain.surfaces import LevelBlocks, Plane, Surface, ThinPlate
from fitting.runtime import files

from .formatting import Table, interval
from .plots import style, terrain_plots

NUMBERS, FIGURE = ".json", ".png"  # beside the mesh, under its name


def check_output_files(mesh: Path) -> None:
    """Checks that the mesh, its numbers and its picture can be written.

    Raises:
        ValueError: if one of them cannot, or the mesh has an unknown suffix.
    """
    mesh_files.check_mesh_name(mesh)
    for path in (mesh, mesh.with_suffix(NUMBERS), mesh.with_suffix(FIGURE)):
        files.check_output_file(path)


def check_new_files(mesh: Path) -> None:
    """Raises ValueError where a file that `write` would write is there already."""
    for path in (mesh, mesh.with_suffix(NUMBERS), mesh.with_suffix(FIGURE)):
        if path.exists():
            raise ValueError(f"{path}: is there already; name another folder")


def remove(mesh: Path) -> None:
    """Removes what `write` has written, as far as it is there."""
    for path in (mesh, mesh.with_suffix(NUMBERS), mesh.with_suffix(FIGURE)):
        path.unlink(missing_ok=True)


def write(mesh: Path, terrain: Reconstruction, clip: Clip, margin: float) -> None:
    """Writes the chosen surface as a mesh, and beside it the numbers and a picture.

    Args:
        mesh: output file, .ply, .obj or .stl.
        terrain: what was reconstructed.
        clip: from which it was.
        margin: how far the mesh extends beyond the stances, m.
    """
    vertices, faces = terrain.surface.mesh(*terrain.extent(margin))
    title = f"Ground of {clip.source}: {describe_surface(terrain)}"
    figure = terrain_plots.plan(terrain, margin, clip.rig.names, title)
    style.save(mesh.with_suffix(FIGURE), figure)
    text = json.dumps(numbers(terrain, clip), indent=2) + "\n"
    files.write_text(mesh.with_suffix(NUMBERS), text)
    files.write(mesh, lambda temporary: mesh_files.save_mesh(temporary, vertices, faces))


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
