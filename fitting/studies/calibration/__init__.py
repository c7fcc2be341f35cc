"""Calibration: an experiment fitted again and again to motion whose truth is known.

`replicates` makes one such fit and, if wanted, its posterior; `calibration` makes many, keeps each
on disk and continues where it was stopped; `assessment` judges them all. Start with
`calibration.calibrate`.
"""
