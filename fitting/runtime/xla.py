"""Settings of XLA and JAX that suit these programs on a CPU; on a GPU they do nothing."""

import os

# Its fusion emitters take two to three times as long to compile a pipeline and do not run faster.
# Vectors are as wide as the core has them; by itself XLA stays at 256 bits, with which legs, feet
# and crowds take a third longer on a core that has 512.
# Sums stay XLA's own: a library call keeps the loop around it from becoming one function, and a
# crowd's gradient, with four of them, takes 1190 ns a leg-frame instead of 720.
# A loop that moves less than so many bytes a turn becomes one function, which spares the calls of
# its hundred small kernels in each turn: a clip's residuals take a third of the time. Here nearly
# every loop does; what is read of a mesh counts as all of it, once for each time it is read. One
# function runs on one core: share what is big out over threads (half of a million rays each: 220 ns
# a ray on two cores, as one call 430; in kernels, which share by themselves, 190 and 320).
XLA = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_prefer_vector_width=512"
    " --xla_cpu_experimental_ynn_fusion_type=-LIBRARY_FUSION_TYPE_REDUCE"
    " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
)
ASYNC = "JAX_CPU_ENABLE_ASYNC_DISPATCH"


def configure_xla() -> None:
    """Sets what the environment has not; to be called before JAX computes anything.

    Besides XLA's flags: a program runs in the thread that calls it. To wake another one for it, as
    JAX does by itself, takes as long as one frame of one character.
    """
    os.environ.setdefault("XLA_FLAGS", XLA)
    if ASYNC not in os.environ:
        import jax  # half a second, for which `jaxik --help` does not wait

        jax.config.update(ASYNC.lower(), False)
