"""XLA and JAX settings that make these programs fast on a CPU; they have no effect on a GPU."""

import ctypes
import os
import warnings
from importlib import metadata

VARIABLE = "XLA_FLAGS"
ASYNC_DISPATCH = "JAX_CPU_ENABLE_ASYNC_DISPATCH"
PLATFORMS = ("JAX_PLATFORMS", "JAX_PLATFORM_NAME")  # either says where JAX computes

# What each flag gains was measured with JAX 0.10.2; in brackets, by CPU time with 0.12.0.1.

# Fusion emitters: two to three times longer to compile a pipeline, and the code is no faster. (From
# jaxlib 0.11.1 on there is nothing else, and a pipeline compiles in less time than before.)
EMITTERS = "--xla_cpu_use_fusion_emitters=false"
# XLA's default is 256 bits, with which legs, feet and crowds take a third longer on a core that
# has 512. (Legs and crowds 40 % longer.)
VECTORS = "--xla_cpu_prefer_vector_width=512"
# Reductions stay XLA's own. A library call keeps the surrounding loop from becoming one function,
# and the gradient of a crowd, which has four of them, takes 1190 ns per leg and frame instead of
# 720. (5 % longer.)
REDUCTIONS = "--xla_cpu_experimental_ynn_fusion_type=-LIBRARY_FUSION_TYPE_REDUCE"
# A loop that moves fewer bytes per iteration than this threshold becomes one function, which saves
# the calls of its hundred small kernels: the residuals of a clip take a third of the time. (Four
# fifths.) Nearly every loop here is below it; a mesh counts in full each time it is read. One
# function runs on one core, so large work must be spread over threads (half a million rays each:
# 220 ns per ray on two cores, 430 as one call; as kernels, which XLA spreads itself, 190 and 320).
LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"

# Each version of jaxlib that was tried, and the flags it knows. XLA ends the process at a flag that
# it does not know, and patch releases remove flags, so an untried version gets none.
FLAGS = {
    **dict.fromkeys(
        ("0.10.0", "0.10.1", "0.10.2", "0.11.0"), (EMITTERS, VECTORS, REDUCTIONS, LOOPS)
    ),
    **dict.fromkeys(("0.11.1", "0.11.2", "0.12.0", "0.12.0.1"), (VECTORS, REDUCTIONS, LOOPS)),
}


# Settings of JAX with the only value that commands can work under, and why.
NEEDED = {
    "jax_debug_nans": (False, "what is missing is NaN"),
    "jax_debug_infs": (False, "some parameters are infinite"),
    "jax_disable_jit": (False, "without compiled programs a fit takes hours"),
    "jax_numpy_rank_promotion": ("allow", "arrays of different ranks are combined"),
    "jax_numpy_dtype_promotion": ("standard", "arrays of different types are combined"),
    "jax_check_tracer_leaks": (False, "every program would be traced anew at each call"),
    "jax_transfer_guard": (None, "arrays come from NumPy and go there"),
}

# Names of mallopt's parameters, from malloc.h of the GNU C library.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
ARRAY = 32 << 20  # bytes; a larger array gets pages of its own, which go back when it is freed
SPARE = 128 << 20  # bytes at the end of the heap that stay with the process
OF_USER = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_", "GLIBC_TUNABLES")


def configure_xla() -> None:
    """Sets XLA flags that suit a CPU; call it before JAX computes anything, or nothing changes.

    Only flags that the installed jaxlib is known to accept are set; with a version that is newer
    than this package there may be none, and everything works, slower. Flags in the environment
    variable `XLA_FLAGS` stay and take precedence; where it is empty or names a file, no flags
    are added.

    Programs also run in the thread that calls them, unless `JAX_CPU_ENABLE_ASYNC_DISPATCH` says
    otherwise: waking another thread, as JAX does by default, takes as long as computing one frame
    of one character. And memory of arrays that were freed stays for new ones
    (`keep_freed_memory`).
    """
    import jax  # takes half a second, which `jaxik --help` should not spend

    if flags := combine_flags(FLAGS.get(jaxlib_version(), ()), os.environ.get(VARIABLE)):
        os.environ[VARIABLE] = flags
    keep_freed_memory()
    if ASYNC_DISPATCH not in os.environ:
        jax.config.update(ASYNC_DISPATCH.lower(), False)


def prefer_cpu() -> None:
    """Has JAX compute on the CPU, unless a variable of the environment names a platform.

    Call it before JAX computes anything. A clip is a loop of small steps, and fits are loops of
    clips: a GPU spends its time starting kernels. Processes that this one starts do likewise.
    """
    import jax

    if not any(name in os.environ for name in PLATFORMS):
        os.environ[PLATFORMS[0]] = "cpu"
        jax.config.update(PLATFORMS[0].lower(), "cpu")


def accelerators() -> list[str]:
    """The names of JAX's plugins for accelerators that are installed here, as `xla_cuda13`."""
    return sorted({plugin.name for plugin in metadata.entry_points(group="jax_plugins")})


def ignore_debugging() -> None:
    """Switches off the settings for debugging that no command can work under, with a warning."""
    import jax

    for name, (value, reason) in NEEDED.items():
        variable = name.upper()
        if variable in os.environ and getattr(jax.config, name) != value:
            jax.config.update(name, value)
            del os.environ[variable]  # processes that this one starts need not say so again
            warnings.warn(f"{variable} is ignored: {reason}", RuntimeWarning, stacklevel=2)


def jaxlib_version() -> str:
    """The installed version of the library that holds XLA."""
    return metadata.version("jaxlib")


def combine_flags(flags: tuple[str, ...], of_user: str | None) -> str:
    """The value of `XLA_FLAGS` that adds flags to the user's; None where the user set none."""
    if of_user is None:
        return " ".join(flags)
    if not of_user.lstrip().startswith("-"):  # empty, or the name of a file with flags
        return of_user
    # The user's come last: of two values for one flag XLA takes the later.
    return " ".join([*(flag for flag in flags if flag not in of_user.split()), of_user])


def describe_flags() -> str:
    """The flags of this process in one line, and whether this version of jaxlib gets none."""
    flags = os.environ.get(VARIABLE) or "none"
    if (version := jaxlib_version()) in FLAGS:
        return flags
    return f"{flags}; which flags jaxlib {version} knows has not been tried"


def keep_freed_memory() -> bool:
    """Lets new arrays reuse the memory of those that were freed; whether that could be set.

    By default the GNU C library returns the memory of large arrays to the system, and each call of
    a program writes its results to new pages. The system clears a page when it is first written
    to, which took 40 % of the time of feet and up to a quarter of that of legs (AMD EPYC, in a
    virtual machine). A process holds at most `SPARE` bytes more for it. Another C library, and what
    the user set in an environment variable, is left alone.
    """
    if any(name in os.environ for name in OF_USER):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not the GNU C library; on Windows there is none
        return False
    return bool(mallopt(M_MMAP_THRESHOLD, ARRAY) and mallopt(M_TRIM_THRESHOLD, SPARE))
