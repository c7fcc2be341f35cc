"""The five systems, each composed of stages; `step` and `run` as in `jaxik`."""
