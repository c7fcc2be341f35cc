"""What needs JAX: devices, XLA flags, cached programs and the self-test.

A process of its own, which prints a finding in each line: `python -m fitting.cli.with_jax`.
"""

import sys
from collections.abc import Iterator

from fitting.cli import jax_start
from fitting.runtime import xla

from .examination import Finding


def examine(*, quick: bool) -> Iterator[Finding]:
    """Everything; `quick` leaves the self-test out."""
    try:
        jax_start.start()
    except jax_start.StartError as error:
        yield Finding("JAX", "does not start", error.problem, error.remedy)
        return
    import jax

    devices = ", ".join(f"{device.platform}: {device.device_kind}" for device in jax.devices())
    others = ", ".join(xla.accelerators()) if jax.default_backend() == "cpu" else ""
    unused = f"; {others} is not used: commands compute on the CPU unless JAX_PLATFORMS is set"
    yield Finding("devices", f"{devices}{unused if others else ''}")
    yield Finding("XLA flags", xla.describe_flags())
    yield _cached_programs()
    if not quick:
        from . import self_test

        yield self_test.examine()


def _cached_programs() -> Finding:
    """Where programs are cached, and how many."""
    from fitting.runtime import cache_folder

    cache_folder.use_default()
    folder = cache_folder.used_folder()
    programs = cache_folder.cached_programs(folder)
    size = sum(path.stat().st_size for path in (*programs.traced, *programs.compiled)) / 1e6
    counts = f"{len(programs.traced)} traced and {len(programs.compiled)} compiled"
    fact = f"{counts}, {size:.1f} MB, {folder}"
    if reason := cache_folder.why_not_cached():
        problem = f"programs are not cached, so that every command compiles anew: {reason}"
        remedy = "set XDG_CACHE_HOME to a folder of your own, and unset JAX's settings for a cache"
        return Finding("programs", fact, problem, remedy)
    return Finding("programs", fact)


if __name__ == "__main__":
    for finding in examine(quick="--quick" in sys.argv):
        print(finding.to_json(), flush=True)
