"""Several clips and subjects: parameters that they share, or that vary between them.

The statistics are those of a nonlinear mixed model. Start with `population_fit.py`, which finds the
fit; `mixed_model.py` is the linear model that it solves in each round, exactly, and `grouping.py`
says which clips have a parameter's value in common.
"""
