"""The best fit of a problem, its posterior, and the identifiability of its parameters.

Everything here takes a `Problem` (`fitting.problem`) and returns numbers. Files, experiments and
reports are elsewhere: `fitting.experiment`, `fitting.studies`, `fitting.report`.

Start with `optimise/search.py`, the way to the best fit, and `sample/posterior.py`. `noise`
estimates sigmas and correlations with the parameters. `identifiability` judges a solution by its
`profiles`, and `sensitivity` finds the parameters that matter before anything is fitted.
`mixed_model` fits clips of several subjects, `proportions` judges many fits whose truth is known.
"""
