"""The posterior of a finished fit, what it predicts, and its report.

`sample` draws it, `replay` plays draws again and compares them with the capture, `run_comparison`
compares sampled runs of several systems. `posterior_report` says and draws it. `sample_jobs` has
`sample` as the user calls it.
"""
