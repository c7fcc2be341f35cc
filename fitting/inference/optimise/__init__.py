"""The search for the best fit: candidates of an evolution, then descents from the best of them.

`search` combines all stages, `solution` has its settings, state and result, `checkpoints` continue
an interrupted one, `evolution` moves candidates over thresholds,
`levenberg_marquardt` makes the steps of a `descent`. Start with `search`.
"""
