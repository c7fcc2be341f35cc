"""A fit, from its clips to its report.

`capture_check` says what clips can tell before anything is solved. `fit` is what a fit found,
`assess` finds it: search, noise, profiles, and the search again where profiles meet a lower point.
`run_folder` saves it. `fit_report` makes its document of `fit_tables`, and draws `fit_plots`.
`fit_jobs` has `fit` as the user calls it, and says what fitting only the game's record costs.
"""
