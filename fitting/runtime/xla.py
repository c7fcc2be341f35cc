"""XLA and JAX settings that make these programs fast on a CPU; they have no effect on a GPU."""

import os

# Fusion emitters: two to three times longer to compile a pipeline, and the code is no faster.
# Vector width: XLA's default is 256 bits, with which legs, feet and crowds take a third longer on
# a core that has 512.
# Reductions stay XLA's own. A library call keeps the surrounding loop from becoming one function,
# and the gradient of a crowd, which has four of them, takes 1190 ns per leg and frame instead of
# 720.
# A loop that moves fewer bytes per iteration than this threshold becomes one function, which saves
# the calls of its hundred small kernels: the residuals of a clip take a third of the time. Nearly
# every loop here is below it; a mesh counts in full each time it is read. One function runs on one
# core, so large work must be spread over threads (half a million rays each: 220 ns per ray on two
# cores, 430 as one call; as kernels, which XLA spreads itself, 190 and 320).
FLAGS = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_prefer_vector_width=512"
    " --xla_cpu_experimental_ynn_fusion_type=-LIBRARY_FUSION_TYPE_REDUCE"
    " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
)
ASYNC_DISPATCH = "JAX_CPU_ENABLE_ASYNC_DISPATCH"


def configure_xla() -> None:
    """Sets XLA flags that suit a CPU; call it before JAX computes anything.

    Environment variables that are already set stay as they are. Programs also run in the thread
    that calls them: waking another thread, as JAX does by default, takes as long as computing one
    frame of one character.
    """
    os.environ.setdefault("XLA_FLAGS", FLAGS)
    if ASYNC_DISPATCH not in os.environ:
        import jax  # takes half a second, which `jaxik --help` should not spend

        jax.config.update(ASYNC_DISPATCH.lower(), False)
