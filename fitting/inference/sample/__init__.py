"""The posterior: an ensemble of walkers of emcee, its chain, and the chain's diagnostics.

`posterior` runs it from a solution to a result. `blocks` splits the parameters that are moved
together, `sampler` moves them, `chain` stores and resumes them, `modes` finds walkers that stay
apart, `diagnostics` judges convergence, `inference_data` writes what ArviZ reads, and
`prior_sensitivity` says how far the posterior rests on its prior. Start with `posterior`.
"""
