"""Noise from data: sigmas, correlations and tails that are estimated with the parameters.

Start with `joint.fit_with_noise`. `series` says what is estimated from the errors of one kind,
`model` puts it into a problem.
"""
