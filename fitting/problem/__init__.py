"""The problem that a fit minimises and a sampler draws from.

A `Problem` joins three things: the `Space` of free parameters, the data, and the function that
gives residuals in standard deviations. It does not depend on the search and the sampler
(`fitting.inference`), nor on files (`fitting.experiment`).

Start with `problem`, which also has the robust losses. `space` describes the parameters and what is
known of them before any data. `scene` and `residuals` are the data of foot IK, `capture_system`
the errors of a capture. `shared_world` runs several clips in a row or side by side, and
`simulation` makes data whose truth is known.
"""
