"""How programs run on this machine: nothing here knows about feet, clips or experiments.

`machine` reads what the system reports of itself, `xla` sets compiler flags, `precision` enables 64
bits, `threads` spreads calls over the cores, `cluster` over machines, `activity` announces what
takes long, `files` writes whole files or none, `json_files` and `claimed_folder` are about files
and folders that other processes may have damaged, left or claimed, `store` about results from which
an interrupted call goes on, `validation` about what users write in TOML, and `declarations` says
once what a table of it holds. `program_cache` caches traced programs between processes,
`cache_folder` says where, and `plain_tree` writes down what a program's input and output are
besides arrays. It holds no settings of the fit.

Start with `files`, which everything that writes uses.
"""
