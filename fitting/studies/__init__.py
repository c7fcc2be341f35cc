"""The studies, each with its computing, its report and its job: deleting its place deletes it.

A fit (`fit`), its posterior (`sample`), a first experiment (`draft`), ablations (`ablation`),
calibrations (`calibrate`), clips of several subjects (`population`), many fits at once (`many`), a
finished system on clips (`animations`), several systems on one clip (`comparison`) or in made
situations (`suite`), translations between systems (`translation`), and reconstructed ground
(`terrain_report`). `campaign` runs those that make many fits, `output` is what the folders of all
have in common, `notebook` what notebooks show, `exports` what other programs read.

A job takes what the user gave, from files to a folder with results; `fitting.jobs` lists them.
Start with `fit.fit`.
"""
