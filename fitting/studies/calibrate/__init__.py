"""Calibration: fits of simulated motion, whose truth is known, and whether what they say is true.

`calibration` runs `replicates` of an experiment's own system, `assessment` judges them. In
`wrong_model` another system makes the motion. Start with `calibration.calibrate`.
"""
