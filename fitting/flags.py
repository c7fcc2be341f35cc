"""Flags of XLA that suit these programs on a CPU; on a GPU they do nothing."""

import os

# Its fusion emitters take two to three times as long to compile a pipeline and do not run faster.
# A loop that moves less than so many bytes a turn becomes one function, which spares the calls of
# its hundred small kernels in each turn: a clip's residuals take a third of the time. Here nearly
# every loop does; what is read of a mesh counts as all of it, once for each time it is read. One
# function runs on one core: share what is big out over threads (half of a million rays each: 220 ns
# a ray on two cores, as one call 430; in kernels, which share by themselves, 190 and 320).
XLA = (
    "--xla_cpu_use_fusion_emitters=false"
    " --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
)


def use() -> None:
    """Sets them where `XLA_FLAGS` is not set; to be called before JAX computes anything."""
    os.environ.setdefault("XLA_FLAGS", XLA)
