"""The search for the best fit: candidates of an evolution, then descents from the best of them.

`search` is the whole way, `solution` what it starts from, its state and what it ends with,
`checkpoints` go on where it was interrupted, `evolution` moves candidates over thresholds,
`levenberg_marquardt` makes the steps of a `descent`. Start with `search`.
"""
