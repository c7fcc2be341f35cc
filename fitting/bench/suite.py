"""All benchmarks of `jaxik bench`, in the order of the table."""

from collections.abc import Mapping

from . import first_run, fits, kernels, throughput
from .measurement import Benchmark

CEILINGS = "machine"  # the benchmark of the machine's limits, with which the others are compared
BENCHMARKS = {
    CEILINGS: Benchmark("memory, arithmetic and dispatch at their best", "", kernels.machine),
    "start": Benchmark("import of jaxik", "", kernels.start),
    "legs": Benchmark("two-bone legs, corrections out", "float32", kernels.legs),
    "feet": Benchmark("feet: two-bone, ankle, updated transforms", "float32", kernels.feet),
    "step": Benchmark("one frame of one character, dispatch included", "float32", kernels.step),
    "rays": Benchmark("rays against Embree", "float32", kernels.rays),
    "crowd": Benchmark("the record pipeline for a crowd", "float32", throughput.crowd),
    "gradient": Benchmark("its gradient, in reverse", "float32", throughput.gradient),
    "jacobian": Benchmark(
        "residuals of twenty parameters and their slopes", "", fits.jacobian, x64=True
    ),
    "clips": Benchmark(
        "slopes of one clip and of six", "float64", fits.clips, x64=True, long=True
    ),
    "fit": Benchmark(
        "a fit of twenty parameters to a clip of 10 s", "float64", fits.fit,
        x64=True, long=True,
    ),
    "first": Benchmark(
        "seconds that a newcomer waits", "float64", first_run.first_run, long=True
    ),
    "posterior": Benchmark("the posterior of that fit", "float64", fits.posterior, x64=True),
    "view": Benchmark("a slider of `jaxik view`", "float64", throughput.drag, x64=True),
    "many": Benchmark(
        "time and memory against devices, clips and workers", "float64", throughput.many, long=True
    ),
    "scaling": Benchmark("time against sizes", "float32", throughput.scaling, long=True),
}  # fmt: skip


def choose(
    benchmarks: Mapping[str, Benchmark], only: str | None, quick: bool = False
) -> dict[str, Benchmark]:
    """The benchmarks of these names, and always that of the ceilings, in the order of the table.

    Without names (`only`, with commas between them) all; of a quick run without the long ones.

    Raises:
        ValueError: for an unknown name, or no name.
    """
    if only is None:
        return {
            name: benchmarks[name] for name in benchmarks if not (quick and benchmarks[name].long)
        }
    names = [name.strip() for name in only.split(",") if name.strip()]
    if unknown := [name for name in names if name not in benchmarks]:
        raise ValueError(f"--only: no rows named {unknown}; there are {list(benchmarks)}")
    if not names:
        raise ValueError(f"--only: wanted names of rows; there are {list(benchmarks)}")
    return {name: benchmarks[name] for name in benchmarks if name in names or name == CEILINGS}
