"""The posterior by emcee's ensemble sampler, with chains that survive a kill.

It samples the hard program, which is not differentiable: no gradients are used.

Start with `posterior.py`. `sampler.py` runs emcee, `chain.py` keeps the steps on disk, in the
format of `chain_file.py`, `islands.py` finds parts of the posterior that lie apart,
`diagnostics.py` decides when a chain is long enough, `prior_sensitivity.py` says what other priors
would change, `blocks.py` how well frames are predicted that were left out, and `inference_data.py`
gives the draws to ArviZ.
"""
