"""A fit, from its clips to its report.

`capture_check` says what clips can tell before anything is solved. `fit` is what a fit found,
`assess` finds it: search, noise, profiles, and the search again where profiles meet a lower point.
`run_folder` saves it. `fit_report` makes its document and draws `fit_plots`; `fit_tables`,
`goodness_report` and `identifiability_report` are its parts. `record_price` says what a game's
record loses. `fit_jobs` has `fit` as the user calls it.
"""
