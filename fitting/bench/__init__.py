"""`jaxik bench`: how fast the pipeline and the fit are on this machine.

Each benchmark is timed next to comparable programs and to the limits of the machine: memory
bandwidth, arithmetic and dispatch. It says nothing about the quality of a motion; for that see
`fitting.motion`.

Start with `benchmarks`: each is a function that fills a `measurement.Measurement`, on `workloads`
of given `Sizes`. `baselines` are comparable programs, `processes` what runs in processes of their
own, `roofline` the limits of the machine, `report` the table and files. `README.md` has results.
"""
