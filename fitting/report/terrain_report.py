"""What is left of a ground that was found from motion: the mesh, its numbers and a picture."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from fitting.datasets.clips.clip import Clip
from fitting.datasets.terrain import mesh_files
from fitting.datasets.terrain.reconstruction import SURFACE_KINDS, Reconstruction
from fitting.datasets.terrain.surfaces import LevelBlocks, Plane, ThinPlate
from fitting.runtime import files

from .formatting import Table, interval
from .plots import style, terrain_plots

NUMBERS, FIGURE = ".json", ".png"  # beside the mesh, under its name


def check_places(mesh: Path) -> None:
    """ValueError where the mesh, its numbers or its picture cannot be written."""
    mesh_files.check_mesh_name(mesh)
    for path in (mesh, mesh.with_suffix(NUMBERS), mesh.with_suffix(FIGURE)):
        files.check_output_file(path)


def write(mesh: Path, found: Reconstruction, clip: Clip, sole: float, margin: float) -> None:
    """Writes the chosen ground as a mesh, and beside it the numbers and a picture.

    Args:
        mesh: its file, .ply, .obj or .stl.
        found: the ground.
        clip: from which it is.
        sole: m, height of the ball joint over the sole that was assumed.
        margin: m, how far the mesh reaches beyond the stances.
    """
    vertices, faces = found.surface.mesh(*found.extent(margin))
    title = f"Ground of {clip.source}: {sentence(found)}"
    figure = terrain_plots.plan(found, margin, clip.rig.names, title)
    style.save(mesh.with_suffix(FIGURE), figure)
    told = json.dumps(numbers(found, clip, sole), indent=2) + "\n"
    files.write_text(mesh.with_suffix(NUMBERS), told)
    files.write(mesh, lambda temporary: mesh_files.save_mesh(temporary, vertices, faces))


def table(found: Reconstruction) -> Table:
    """How well each kind of ground predicts a stance from the others."""
    head = ["ground", "error, cm rms", "median", "alone on a block", "error without those"]
    rows = [head]
    for kind in SURFACE_KINDS:
        one = found.predictions[kind]
        alone = int(one.alone.sum())
        without = f"{100 * one.rms_shared:.2f}" if 0 < alone < len(one.errors) else ""
        size = np.median(np.abs(one.errors))
        count = f"{alone} of {len(one.errors)}" if kind == "blocks" else ""
        name = f"{kind} (chosen)" if kind == found.chosen else kind
        rows.append([name, f"{100 * one.rms:.2f}", f"{100 * size:.2f}", count, without])
    return rows


def counted(found: Reconstruction) -> str:
    """How many stances there are, and how many were used."""
    stances = found.stances
    text = f"{len(stances.leg)} stances"
    if stances.toes.any():
        used = int((stances.toes & stances.used).sum())
        text += f"; {int(stances.toes.sum())} on toes, {used} of them used"
    return text


def sentence(found: Reconstruction) -> str:
    """The chosen ground in words."""
    surface, ranked = found.surface, found.grids
    match surface:
        case LevelBlocks():
            grid, count = surface.grid, len(surface.tops)
            low, high = np.degrees(ranked.headings)
            return (
                f"level blocks of {grid.pitch:.2f} m ({interval(*np.round(ranked.pitches, 2))} m are "
                f"about as likely), turned by {np.degrees(grid.heading):.1f}° ({low:.1f}° to "
                f"{high:.1f}°), {count} of them visited"
            )
        case Plane():
            return f"a plane that rises by {np.degrees(np.arctan(np.hypot(*surface.slope))):.2f}°"
        case ThinPlate():
            low, high = 100 * surface.lowest, 100 * surface.highest
            return f"a smooth surface from {low:.1f} to {high:.1f} cm"
        case _:
            raise TypeError(f"no words for {surface}")


def numbers(found: Reconstruction, clip: Clip, sole: float) -> dict[str, Any]:
    """What JSON holds: metres, radians, frames; null where nothing is known."""
    stances, used = found.stances, np.cumsum(found.stances.used) - 1
    rows = []
    for i in range(len(stances.leg)):
        row: dict[str, Any] = {
            "leg": clip.rig.names[stances.leg[i]],
            "first_frame": int(stances.first[i]),
            "last_frame": int(stances.last[i]),
            "x": _tidy(stances.points[i, 0]),
            "z": _tidy(stances.points[i, 1]),
            "height": _tidy(stances.heights[i]),
            "on_toes": bool(stances.toes[i]),
            "used": bool(stances.used[i]),
        }
        if stances.used[i]:
            errors = {
                kind: _tidy(float(one.errors[used[i]])) for kind, one in found.predictions.items()
            }
            row |= {"errors": errors, "alone": bool(found.predictions["blocks"].alone[used[i]])}
        rows.append(row)
    return {
        "clip": clip.source,
        "frames": clip.frame_count,
        "fps": clip.fps,
        "ball_over_sole": sole,
        "chosen": found.chosen,
        "tested": {
            kind: {
                "rms": _tidy(one.rms),
                "median": _tidy(float(np.median(np.abs(one.errors)))),
                "stances": len(one.errors),
                "alone": int(one.alone.sum()),
                "rms_without_alone": _tidy(one.rms_shared),
            }
            for kind, one in found.predictions.items()
        },
        "grounds": {kind: _describe(found, kind) for kind in SURFACE_KINDS},
        "stances": rows,
    }


def _describe(found: Reconstruction, kind: str) -> dict[str, Any]:
    surface, ranked = found.surfaces[kind], found.grids
    match surface:
        case LevelBlocks():
            return {
                "pitch": _tidy(surface.grid.pitch),
                "pitches_about_as_likely": [_tidy(one) for one in ranked.pitches],
                "heading": _tidy(surface.grid.heading),
                "headings_about_as_likely": [_tidy(one) for one in ranked.headings],
                "origin": [_tidy(one) for one in surface.grid.origin],
                "cell_of": "u = cos(heading) x + sin(heading) z, v = -sin(heading) x + "
                "cos(heading) z; i = floor((u - origin[0]) / pitch), j likewise of v",
                "blocks": [
                    {"i": int(i), "j": int(j), "height": _tidy(top), "stances": int(count)}
                    for (i, j), top, count in zip(
                        surface.cells, surface.tops, surface.stances, strict=True
                    )
                ],
            }
        case Plane():
            return {
                "level_at_origin": _tidy(surface.level),
                "slope": [_tidy(one) for one in surface.slope],
            }
        case ThinPlate():
            return {"smoothing": surface.smoothing}
        case _:
            raise TypeError(f"no words for {surface}")


def _tidy(value: float) -> float | None:
    """To a tenth of a millimetre; null for what is not known."""
    return None if np.isnan(value) else round(float(value), 4) + 0.0
