"""Code in other languages with the answers of `jaxik.step`: C for now.

`export.export_c` writes it. `program` traces a system, `stablehlo` turns the trace into a `graph`
of operations on single numbers, `repeats` and `schedule` divide that into functions, and `c_code`
and `header` write them. `trace` records what `check.c` replays, and `toolchain` compiles and runs
the result.
"""
