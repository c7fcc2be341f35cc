"""The benchmarks. Each is a function that gets a `Measurement` and the `Sizes`, and fills it.

`ceilings` measures the machine itself, `kernels` parts of the pipeline, `crowd` all of it,
`inference` fits, `live` the viewer, and `scaling` one size at a time. `baselines` are programs to
compare with.
"""
