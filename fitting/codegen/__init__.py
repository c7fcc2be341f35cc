"""Code in other languages with the answers of `jaxik.step`.

`export.export_system` writes it. `program` traces a system, `stablehlo` turns the trace into a
`graph` of operations on single numbers, `repeats` and `schedule` divide that into `functions`, and
`c_code` and `header` write them in C. `trace` records what `check.c` replays, and `toolchain`
compiles and runs the result.
"""
