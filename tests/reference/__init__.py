"""Foot IK once more in plain NumPy float64: one character, one leg, one frame at a time.

An independent implementation of all five systems to compare `jaxik` with. Nothing here imports
`jaxik`. Start with `systems.record`.
"""
