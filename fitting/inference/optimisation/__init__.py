"""The search for the best fit.

A search is a chain of stages, each a function `(search, state, ...) -> state` that can be called by
itself. It is made for costs with plateaus and cliffs, not for smooth ones only: for those
Levenberg–Marquardt alone is enough.

Start with `search.py`, which puts the stages together. The stages are in `descent.py`,
`population.py`, `sweep.py` and `evolution.py`; what they share is in `state.py` and `settings.py`.
`kept_stages.py` lets a search that was killed go on.
"""
