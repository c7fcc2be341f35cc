"""`report.html`: what a run found on one page that opens from disk, with the motion in 3-D.

`fit_page` makes the page of a fit: `sentences` words what was found, `figures` makes tables and
interval plots, `motion_data` packs the motions, and `rendering` fills the templates.
`posterior_section` adds what sampling finds. The page has
its styles and scripts, in `assets`, within itself, and loads nothing.
"""
