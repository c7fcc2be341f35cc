"""Terrain: surfaces under one up direction, and rays cast onto them along -up.

All rays of a terrain are parallel, so a mesh needs no tree: projected along up it is a plane
drawing, and a grid over that drawing (`grid`) says which triangles a ray can hit. Which triangle is
hit is a discrete answer without a gradient. Where it is hit, and at what angle, follows from the
plane of the triangle and is differentiable in the ray, up and the vertices.

`building` makes terrains, `rays` casts rays onto them, `hits` has ground whose hits a game gives.
"""

from .building import combine as combine
from .building import function as function
from .building import heightfield as heightfield
from .building import layer_mask as layer_mask
from .building import merge as merge
from .building import mesh as mesh
from .building import moving as moving
from .building import plane as plane
from .hits import GivenHits as GivenHits
from .hits import from_hits as from_hits
from .rays import ALL_LAYERS as ALL_LAYERS
from .rays import HORIZON as HORIZON
from .rays import Hit as Hit
from .rays import LegTerrains as LegTerrains
from .rays import Terrain as Terrain
from .rays import cast as cast
