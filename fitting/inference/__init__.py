"""The best fit of a problem, its posterior, and what the data determine of it.

Everything here takes a `Problem` (`fitting.problem`) and returns numbers. Files, experiments and
reports are elsewhere: `fitting.experiments`, `fitting.studies`, `fitting.report`.

Start with `optimisation/search.py`, the way to the best fit, and `sampling/posterior.py`. `noise/`
estimates sigmas and correlations with the parameters. `identifiability.py` judges a solution by its
`profiles`, and `sensitivity.py` finds the parameters that matter before anything is fitted.
`calibration/` judges many fits whose truth is known.
"""
