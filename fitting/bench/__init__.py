"""`jaxik bench`: how fast the pipeline and the fit are on this machine.

Each benchmark is timed next to comparable programs and to the limits of the machine: memory
bandwidth, arithmetic and dispatch. It says nothing about the quality of a motion; for that see
`fitting.motion`.

Start with `suite`, the list of benchmarks. Each is a function in `benchmarks/` that fills a
`measurement.Measurement`; `runner` calls them in turn, `report` writes what they measured.
`workloads` makes what they run on, at the sizes of `sizes`. `README.md` has results.
"""
