"""How programs run on this machine: nothing here knows about feet, clips or experiments.

`xla` sets compiler flags, `threads` spreads calls over the cores, `program_cache` keeps traced
programs between processes, `files` writes whole files or none, `validation` checks what users
write in TOML. It holds no settings of the fit. Start with `files`, which everything that writes
uses.
"""
