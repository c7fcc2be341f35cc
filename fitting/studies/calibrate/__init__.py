"""Calibration: fits of simulated motion, whose truth is known, and whether what they say is true.

`calibration` simulates motion by the experiment's own system, `wrong_model` by another one;
`replicates` makes and saves what both fit. Start with `calibration.calibrate`.
"""
