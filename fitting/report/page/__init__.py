"""`report.html`: what a job found on one page that opens from disk, with the motion in 3-D.

`fit_page` makes the page of a fit: `sentences` words what was found, and `figures` makes tables and
interval plots; `posterior_section` adds what sampling finds. The pages of other jobs, in
`comparisons` and `studies`, are put together from the parts that `study_page` has. `motion_data`
packs motions, `pictures` embeds plots, and `rendering` fills the templates. A page has its styles
and scripts, in `assets`, within itself, and loads nothing.
"""
