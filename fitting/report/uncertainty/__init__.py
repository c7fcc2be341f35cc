"""Tables and texts on how certain the parameters are.

`priors` shows what was known before any clip, beside what the fit or the posterior leaves of it.
"""
