"""Benchmark of the viewer: how long a clip is solved for when a slider has moved."""

import functools
import itertools
import time

import numpy as np

from fitting.bench import workloads
from fitting.bench.measurement import FigureSpec, Measurement
from fitting.bench.sizes import Sizes
from fitting.datasets.clips import edit
from fitting.experiments.problems import ClipData
from fitting.experiments.systems import Preset
from fitting.viewer import Solver, Subject, Take, knobs
from fitting.viewer.subject import DEFAULT, cost_of_problem
from jaxik.world import terrain

RATE = 30.0  # Hz, of the clip
TARGET = 100.0  # ms, from which a drag feels slow
DRAGS = 50  # different ones, of any number


def subject(frame_count: int) -> Subject:
    """A recording at 30 Hz of so many frames at 60 Hz, with the cost of twenty parameters."""
    reference, base, mesh = workloads.recording(frame_count)
    reference, base = (edit.resample(clip, RATE) for clip in (reference, base))
    data = ClipData(reference, base, terrain.mesh(mesh.vertices, mesh.faces))
    problem = workloads.problem_from_clips([data])
    take = Take("walk", base, data.terrain, problem.data[0].frames, captured=reference)
    cost = functools.partial(cost_of_problem, problem)
    starts = {DEFAULT: problem.space.system}
    return Subject("walk", (take,), starts, Preset("record", faithful=True), cost=cost)


def drag(measurement: Measurement, sizes: Sizes) -> None:
    """Solves a clip of 10 s again for other values: motion, feet, overlays and cost."""
    walk = subject(sizes.frames)
    solver, ik = Solver(walk), walk.starts[DEFAULT]
    measurement.progress("view: compiling solve")
    start = time.perf_counter()
    solver.solve(ik)
    measurement.compile_s["solve"] = time.perf_counter() - start
    random = np.random.default_rng(0)
    numbers = [knob for knob in knobs(ik, walk.rig) if not knob.is_switch]
    chosen = [numbers[i] for i in random.integers(len(numbers), size=DRAGS)]
    drags = itertools.cycle([(knob, float(random.uniform(knob.low, knob.high))) for knob in chosen])

    def solve() -> None:
        knob, value = next(drags)
        solver.solve(knob.write(ik, value))

    measurement.time_in_turns({"drag": solve})
    seconds = solver.take.base.seconds
    what = f"a drag, {seconds:.0f} s at {RATE:g} Hz"
    spec = FigureSpec(what=what, unit="ms", scale=1e3, at_most=TARGET)
    measurement.add_timing("drag", spec)
