"""Cold fits, each in a process of its own.

`python -m fitting.bench.benchmarks.cold_fit FOLDER` is that process: it fits the clip in the
folder and prints the seconds that the search took.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from fitting.bench import workloads
from fitting.bench.measurement import Measurement, time_calls
from fitting.bench.sizes import Sizes
from fitting.datasets.clips import load_clip, save_clip
from fitting.datasets.terrain.mesh_files import load_terrain, save_mesh
from fitting.inference.optimisation.search import find_best_fit

CLIPS, GROUND = ("reference.npz", "base.npz"), "ground.ply"


def sample(measurement: Measurement, sizes: Sizes) -> None:
    """Adds samples of processes that fit, each with an empty cache first and then with a full one.

    The samples are named "cold, empty cache" and "cold, persistent cache"; the time of the search
    within the process "its search, ...".
    """
    searches: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        reference, base, ground = workloads.recording(sizes.frames)
        for name, clip in zip(CLIPS, (reference, base), strict=True):
            save_clip(Path(folder, name), clip)
        save_mesh(Path(folder, GROUND), ground.vertices, ground.faces)
        for number in range(sizes.fits):
            with tempfile.TemporaryDirectory() as cache:
                environment = {
                    "JAX_ENABLE_X64": "1",
                    "JAX_ENABLE_COMPILATION_CACHE": "1",
                    "JAX_COMPILATION_CACHE_DIR": cache,
                    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",  # as in the commands
                }
                for state in ("empty", "persistent"):
                    name = f"cold, {state} cache"
                    measurement.progress(f"fit: {name}, run {number + 1} of {sizes.fits}")
                    seconds, cpu_seconds = time_calls(
                        lambda: searches.append(_fit_in_process(folder, environment))  # noqa: B023
                    )
                    measurement.samples.setdefault(name, []).append(seconds)
                    measurement.busy.setdefault(name, []).append(cpu_seconds)
                    search = f"its search, {state} cache"
                    measurement.samples.setdefault(search, []).append(searches[-1])


def _fit_in_process(folder: str, environment: Mapping[str, str]) -> float:
    """Seconds of the search in a new process, which also imports and reads the clip."""
    finished = subprocess.run(
        [sys.executable, "-m", "fitting.bench.benchmarks.cold_fit", folder],
        env=os.environ | environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    return float(finished.stdout)


def main() -> None:
    """Fits once and prints the seconds."""
    folder = Path(sys.argv[1])
    reference, base = (load_clip(folder / name) for name in CLIPS)
    clip_data = workloads.ClipData(reference, base, load_terrain(folder / GROUND))
    print(f"{find_best_fit(workloads.problem_from_clips([clip_data])).seconds:.2f}")


if __name__ == "__main__":
    main()
