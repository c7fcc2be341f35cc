"""`jaxik bench`: how fast the pipeline and the fit are on this machine.

Each benchmark is timed next to comparable programs and to the limits of the machine: memory
bandwidth, arithmetic and dispatch. It says nothing about the quality of a motion; for that see
`fitting.motion`.

Start with `suite`, which lists the benchmarks and calls them in turn. Each is a function that fills
a `measurement.Measurement`; `report` writes what they measured. `workloads` makes what they run on,
with its `Sizes`. `README.md` has results.
"""
