"""Profiles: how far the cost must rise when one parameter is held at a value and all others follow.

`profile.py` reads intervals, valleys and a verdict off the curve of one parameter. The others find
the curves: `curves.py` holds their points, `conditional.py` finds the lowest cost at given values,
`single_moves.py` the thresholds to begin with there, and `profiling.py` chooses the values.
"""
