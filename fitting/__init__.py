"""Fits the parameters of `jaxik` to captured motion, and says how certain they are.

It reads clips and terrain, builds a least-squares problem, searches for the best fit, samples the
posterior, and writes reports; the command `jaxik` does the same from a shell. It is not foot IK
(that is `jaxik`), not a motion editor and not a renderer.

Start with `fit`: it takes an experiment, which `load_experiment` reads from a file. The rooms, each
importing only those before it: `runtime`, `codegen`, `clips`, `ground`, `synthetic`, `problem`,
`inference`, `motion`, `experiment`, `report`, `studies`, `viewer`, `jobs`, `bench`, `cli`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
