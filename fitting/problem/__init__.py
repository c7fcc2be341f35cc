"""What a fit minimises and a sampler draws from.

A `Problem` joins three things: the `Space` of free parameters, the data, and the function that
gives residuals in standard deviations. It knows nothing of how the minimum is found or the
posterior is sampled (`fitting.inference`), nor of files (`fitting.experiments`).

Start with `problem.py`. `free_parameters.py` and `space.py` describe the parameters, `prior.py`
says what is known of them before any data. `scene.py` and `residuals.py` are the data of foot IK,
`shared_world.py` runs several clips in a row, `stacking.py` side by side. `loss.py` has the robust
losses, `simulation.py` makes data whose truth is known, `digest.py` tells problems apart.
"""
