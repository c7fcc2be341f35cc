"""`Model`: the file that a clip came from, with the meshes that hang on its skeleton."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True, eq=False)
class Model:
    """A glTF file with a skinned mesh, whose animation can be replaced.

    No node of its skeleton is scaled differently along its axes.
    """

    header: Mapping[str, Any]
    """Its JSON; all buffers are one, the binary part."""
    binary: bytes
    nodes: Mapping[str, int]
    """Number of the node of each joint, by the joint's name."""
    scales: Mapping[str, float]
    """Of each joint in the world, m for each unit of length in its space."""
    above: Float64[np.ndarray, "4 4"]
    """From the space in which the skeleton's root is placed to the world."""
