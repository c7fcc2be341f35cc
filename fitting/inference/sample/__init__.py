"""The posterior: an ensemble of walkers of emcee, its chain, and the chain's diagnostics.

`posterior` runs it from a solution to a result. `blocks` has the settings and the log-likelihood
of blocks of frames, `sampler` moves the walkers, `chain` stores and resumes them, `modes` finds
walkers that stay apart, `diagnostics` judges convergence, `inference_data` writes files for ArviZ,
and `prior_sensitivity` says how far the posterior rests on its prior. Start with `posterior`.
"""
