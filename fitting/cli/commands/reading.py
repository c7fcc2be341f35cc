"""How clips and terrain are read, as the options say it."""

import argparse
from dataclasses import fields

from fitting.clips.load import ClipOptions
from fitting.ground.meshes import TerrainOptions


def clip_options(options: argparse.Namespace) -> ClipOptions:
    """How the clip is read.

    Args:
        options: what `parsers.options.add_clip_options` adds.
    """
    names = (field.name for field in fields(ClipOptions))
    return ClipOptions(**{name: getattr(options, name) for name in names})


def terrain_options(options: argparse.Namespace) -> TerrainOptions:
    """How the terrain is read.

    Args:
        options: what `parsers.options.add_terrain_options` adds.
    """
    x, y, z = options.terrain_offset
    return TerrainOptions(options.file_up, options.terrain_scale, (x, y, z), options.terrain_cell)
