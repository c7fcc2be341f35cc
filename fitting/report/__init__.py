"""What people read after a job: summaries in Markdown, tables for the terminal, pictures.

Nothing here computes: reports word and draw what `fitting.studies` and `fitting.analysis` return.

Start with `fit_report`, which writes the summary of a fit; the other modules named `*_report` do
the same for the other jobs, or for a section of a summary. `uncertainty/` has tables of what is
known of the parameters, `calibration/` the report of a calibration. `labels` names every number
and its unit, `formatting` sets numbers, and tables as text that knows its cells, and `plots/`
draws.
"""
