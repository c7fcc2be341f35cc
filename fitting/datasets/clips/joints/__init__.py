"""Names of joints: the conventions that are recognised, and joint maps for all others.

`dialects` is the table of conventions, and what recognises them; to support another one, add a line
to `DIALECTS`. `map_files` reads and writes joint maps, in which a user says which joint is which.
"""
