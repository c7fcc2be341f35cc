"""The studies: what is computed for a fit, a posterior, a comparison, an ablation, a translation.

A study takes an experiment or systems, and returns numbers; `run_folder` keeps those of a fit on
disk. It writes no reports and prints nothing: that is for `report`, and `jobs` runs a study from
its files to its report. Start with `fit`.
"""
