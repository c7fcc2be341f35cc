"""Profiles: how far the cost must rise when one parameter is held at a value and all others follow.

`profile` reads intervals, local minima and a verdict off the curve of one parameter, and holds its
points. `conditional` finds the lowest cost at given values, and `profiling` chooses the values and
the thresholds to begin with there.
"""
