"""Many systems, clips and fits: time and memory against devices, clips and workers.

Each point is a process of its own, so that its peak of memory is its own, too:
`python -m fitting.bench.benchmarks.many WHAT COUNT` prints its numbers as JSON. Devices are those
of this machine, or simulated ones, which share its cores: they show what sharing costs.
"""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from fitting.bench import workloads
from fitting.bench.measurement import Figure, Measurement, Series
from fitting.bench.sizes import Sizes
from fitting.runtime.parallel.effort import Stopwatch, peak_mb
from fitting.runtime.threads import usable_cores

FRAMES = 60
LENGTHS = 33, 50  # frames of the shortest and of the longest of many clips
SYSTEMS = 4096  # shared out among devices
FITS = 8  # shared out among workers
LONGEST = (
    300.0  # s of a point, compiling included, after which larger ones of its curve are left out
)
SIMULATED = "--xla_force_host_platform_device_count={}"
EXPERIMENT = """
preset = "record"
faithful = true
[[clips]]
reference = "reference.npz"
base = "base.npz"
terrain = "ground.ply"
[free]
pelvis.on_gain = {}
foot.max_pitch = { low = 0.1 }
[fit]
starts = 1
"""


def many(measurement: Measurement, sizes: Sizes) -> None:
    """Time and peak of memory against devices, clips and workers."""
    sharing = 2 * usable_cores()
    _vary(measurement, "devices", sizes.devices, f"{SYSTEMS} systems", sharing)
    _vary(measurement, "clips", sizes.clips, "a system")
    _vary(measurement, "workers", sizes.workers, f"{FITS} fits", sharing)
    measurement.notes.append(
        "devices are simulated where there is one: they share its cores, so that time should stay; "
        "seconds are those after compiling, of workers those of all, starting them included; the "
        "peak of workers is the largest of one process, and every peak includes compiling"
    )


def _vary(
    measurement: Measurement, what: str, counts: Sequence[int], curve: str, most: float = math.inf
) -> None:
    """Adds a series with the memory peak of each point.

    What is left out, and why, is a note: more than `most`, which would share the same cores, and
    whatever is larger than a point that took long or failed.
    """
    series = Series(what, [], {})
    measurement.series.append(series)
    result = ""
    for index, count in enumerate(counts):
        if count > most:
            _leave_out(measurement, what, counts[index:], "two share each core already")
            return
        measurement.progress(f"many: {count} {what}, {index + 1} of {len(counts)}{result}")
        began = time.monotonic()
        try:
            point = _measured(what, count)
        except subprocess.CalledProcessError as error:
            last = (error.stderr or "").strip().rpartition("\n")[2]
            measurement.failures.append(f"{count} {what}: {last or error}")
            _leave_out(measurement, what, counts[index + 1 :], f"{count} failed")
            return
        series.sizes.append(count)
        label = f"{curve}, {count} {what}"
        for name, key in (("", "seconds"), (": CPU time", "cpu_seconds")):
            series.seconds.setdefault(f"{curve}{name}", []).append(point[key])
            measurement.add(Figure(f"{label}{name}", point[key], "s"))
        measurement.add(Figure(f"{label}: peak of memory", point["peak_mb"], "MB"))
        result = f"; {count}: {point['seconds']:.2g} s"
        if (took := time.monotonic() - began) > LONGEST:
            _leave_out(measurement, what, counts[index + 1 :], f"{count} took {took:.0f} s")
            return


def _leave_out(measurement: Measurement, what: str, counts: Sequence[int], why: str) -> None:
    if counts:
        measurement.notes.append(f"left out: {', '.join(map(str, counts))} {what}, as {why}")


def _measured(what: str, count: int) -> Mapping[str, float]:
    """The numbers of a point, of a process of its own.

    Raises:
        subprocess.CalledProcessError: it has failed.
    """
    environment = os.environ | ({"XLA_FLAGS": _flags(count)} if what == "devices" else {})
    finished = subprocess.run(
        [sys.executable, "-m", "fitting.bench.benchmarks.many", what, str(count)],
        env=environment, check=True, capture_output=True, text=True,
    )  # fmt: skip
    return json.loads(finished.stdout.splitlines()[-1])


def _flags(devices: int) -> str:
    """The flags of this process with simulated devices."""
    return f"{os.environ.get('XLA_FLAGS', '')} {SIMULATED.format(devices)}".strip()


def of_devices(count: int) -> dict[str, float]:
    """Many systems on a clip, on so many devices."""
    import jax

    import fitting

    problem = workloads.problem(FRAMES)
    ik = problem.space.unpack(problem.space.start)
    batch = fitting.vary(ik, {"pelvis.on_gain": np.linspace(0.05, 0.9, SYSTEMS)})
    devices = jax.local_devices()[:count]
    return _second_time(lambda: fitting.evaluate_many(batch, problem.data, devices=devices))


def of_clips(count: int) -> dict[str, float]:
    """A system on so many clips of different length on one ground."""
    import fitting

    problem = workloads.problem(max(LENGTHS))
    ik = problem.space.unpack(problem.space.start)
    lengths = np.linspace(*LENGTHS, count).astype(int)
    clips = [workloads.first_frames(problem.data[0], length) for length in lengths]
    single = fitting.vary(ik, {"pelvis.on_gain": [0.2]})
    return _second_time(lambda: fitting.evaluate_many(single, clips))


def of_workers(count: int) -> dict[str, float]:
    """Fits of a clip with several seeds, on so many workers of this machine."""
    import fitting
    from fitting.datasets.clips import save_clip
    from fitting.datasets.terrain.mesh_files import save_mesh
    from fitting.runtime import cache_folder

    cache_folder.use_default()
    with tempfile.TemporaryDirectory() as folder:
        reference, base, ground = workloads.recording(FRAMES)
        save_clip(Path(folder, "reference.npz"), reference)
        save_clip(Path(folder, "base.npz"), base)
        save_mesh(Path(folder, "ground.ply"), ground.vertices, ground.faces)
        path = Path(folder, "walk.toml")
        path.write_text(EXPERIMENT, encoding="utf-8")
        fitting.fit_many(path, Path(folder, "first"), workers=1, report=False)  # compiles
        began = time.monotonic()
        fits = fitting.fit_many(path, Path(folder, "fits"), seeds=FITS, workers=count, report=False)
        efforts = [row["effort"] for row in fits.finished if "effort" in row]
        return {
            "seconds": time.monotonic() - began,
            "cpu_seconds": sum(effort["cpu_seconds"] for effort in efforts),
            "peak_mb": max(effort["peak_mb"] or float("nan") for effort in efforts),
        }


def _second_time(call: Callable[[], object]) -> dict[str, float]:
    """What a call takes after one that compiles; the peak is that of both."""
    call()
    watch = Stopwatch()
    call()
    effort = watch.read()
    return {
        "seconds": effort["seconds"],
        "cpu_seconds": effort["cpu_seconds"],
        "peak_mb": peak_mb() or float("nan"),
    }


POINTS = {"devices": of_devices, "clips": of_clips, "workers": of_workers}


def main() -> None:
    """Measures one point and prints it."""
    import jax

    import fitting

    fitting.configure_xla()
    jax.config.update("jax_enable_x64", True)
    what, count = sys.argv[1:]
    print(json.dumps(POINTS[what](int(count))))


if __name__ == "__main__":
    main()
