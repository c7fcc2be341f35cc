"""Spheres and capsules swept along -up, beside rays: where a body of some width would rest.

A ray falls into every crack; a shape as wide as a foot does not, and rolls softly over edges.
`shapes` has the contacts with edges, triangles and parallelograms, `surfaces` those with each kind
of surface. Start with `sweep`.
"""

from .sweeping import sweep as sweep
from .sweeping import sweepable as sweepable
