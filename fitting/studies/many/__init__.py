"""Many fits: what is to be fitted, each fit's row, and the table of all rows.

`fit_many` is the job, `many_tasks` what workers do and keep, `many_report` the table and the page.
`evaluation` is another kind of many: a huge batch of systems in one jitted call.
"""
