"""Many systems on many clips: a million parameter sets on one, or one on a thousand clips.

Work goes through one program for each shape of clip, in chunks of one size: the last one is filled
up. A chunk is spread over the devices of this process, and chunks over the processes that
`jax.distributed` has brought together, which at the end exchange their results.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, PyTree

import jaxik
from fitting.codegen.crowd import Axes, NoKernelError, kernel_of, run_crowd
from fitting.experiment.experiment import Experiment
from fitting.experiment.experiment_files import load_experiment
from fitting.experiment.problems import make_problem
from fitting.inference.sharding import EVERYWHERE
from fitting.problem import shared_world
from fitting.problem.residuals import errors_by_kind, over_frames, residuals_by_kind
from fitting.problem.scene import Scene
from fitting.problem.shared_world import run_scene
from fitting.runtime import activity
from fitting.runtime.precision import in_float64, with_floats
from fitting.runtime.threads import on_all_cores, usable_cores
from jaxik import lanes
from jaxik.maths import parameter_tree
from jaxik.world.terrain import Terrain

BATCH = "batch"  # the axis of the devices
MEMORY = 1e9  # bytes that chunks take at once, together
# Bytes of a system on a clip, while it is computed, over those of all that `run` returns for it.
# Measured of compiled programs, float64, CPU, 8 to 64 at a time: 0.40 of systems on a clip; 0.53 of
# clips with a system, and 0.27 for the clips themselves. The shorter the clips, the more: of half a
# second, 16 at a time, with all that they share, 2.6.
WORKSPACE = 3.0
CACHED = 64  # systems, or clips, at a time on a core of a CPU
# Legs times frames, of all systems and clips, from which C code pays: it is written anew in each
# process, in seconds, where JAX's programs are cached, and saves a second in about 16 million.
WORTH = 5e7
BY_KERNEL = 1024  # likewise, of C code: a call takes milliseconds, whatever it computes
Measure: TypeAlias = Callable[[Scene, jaxik.Result], Mapping[str, Float[Array, "*numbers"]]]
"""What is measured of a system on a clip. It must be a function of a module, as a new lambda for
each call would compile anew. Frames that were not observed should not count: clips get more."""
Stacked: TypeAlias = tuple[bool, ...] | None
KINDS = ("ankle", "knee", "pelvis", "foot", "body")


def errors_and_cost(scene: Scene, result: jaxik.Result) -> dict[str, Float[Array, ""]]:
    """Root mean squares of the errors, m and rad, over observed frames; and the cost.

    The cost is half the sum of the squared residuals, without any prior.
    """
    errors = errors_by_kind(scene, result)
    measured = {}
    for name in KINDS:
        counts = scene.counts(name)
        squares = jnp.where(over_frames(counts, errors[name]), errors[name] ** 2, 0)
        measured[name] = jnp.sqrt(jnp.sum(squares) / jnp.maximum(jnp.sum(counts), 1))
    residuals = residuals_by_kind(scene, errors)
    measured["cost"] = 0.5 * sum((jnp.sum(r**2) for r in residuals.values()), jnp.zeros(()))
    return measured


def vary(ik: jaxik.FootIK, values: Mapping[str, Any]) -> jaxik.FootIK:
    """A batch of systems that differ in some parameters, for `evaluate_many`.

    Args:
        ik: one system.
        values: by dotted name, with as many values in each, on the first axis.

    Raises:
        ValueError: a name is unknown, or a parameter has another number of values than others.
    """
    arrays = {name: np.asarray(value) for name, value in values.items()}
    counts = {name: array.shape[0] if array.ndim else None for name, array in arrays.items()}
    if len(set(counts.values())) != 1 or None in counts.values():
        raise ValueError(f"values per parameter: {counts}; wanted the same number of each")
    return parameter_tree.replace(jax.tree.map(lambda leaf: leaf[None], ik), arrays)


@in_float64
def evaluate_many(
    ik_batch: jaxik.FootIK,
    clips: Experiment | str | Path | Sequence[Scene],
    measure: Measure = errors_and_cost,
    *,
    chunk: int | None = None,
    memory: float = MEMORY,
    devices: Sequence[Any] | None = None,
) -> dict[str, Float[np.ndarray, "systems clips *numbers"]]:
    """Measures every system of a batch on every clip.

    Memory holds one chunk at a time, or on a CPU one for each core, beside clips and results. A
    chunk has as many systems, or clips, as `memory` allows by what one takes, the bytes of all that
    `jaxik.run` returns for it; on a CPU at most 64 for each device. With several processes
    (`jax.distributed.initialize`) each computes its part, and all get everything.

    Where the arrays of the clips have 32 bits (`with_floats`) and there is a C compiler, large work
    runs as `fitting.run_crowd` runs it, on any ground but meshes.

    Args:
        ik_batch: systems, with an axis for them in front of each array; where its length is 1, all
            share the array. `vary`, and `jax.vmap` of anything that makes a system, make one.
        clips: an experiment, the path of its file, or the data of a problem. Of any length; each
            shape of ground has a program of its own, and lengths share a few.
        measure: what is measured, as a mapping of arrays; by default errors and cost.
        chunk: how many systems, or clips where there are more of these, to compute at once.
        memory: bytes, of all chunks that are computed at once.
        devices: of this process; None takes all of them.

    Raises:
        ValueError: the batch has no axis, or axes of different length; there is no clip; the chunk
            is below 1; clips cannot be read.
    """
    scenes = _scenes(clips)
    count = _batch_size(ik_batch)
    if chunk is not None and chunk < 1:
        raise ValueError(f"chunk is {chunk}; wanted 1 or more, or None")
    mesh = Mesh(np.array(jax.local_devices() if devices is None else devices), (BATCH,))
    dtype = scenes[0].frames.dt.dtype
    ik_batch = jax.tree.map(np.asarray, with_floats(jax.tree.map(jnp.asarray, ik_batch), dtype))
    results: dict[str, np.ndarray] = {}
    done = 0
    with activity.announced(f"Running {count} systems on {len(scenes)} clips", count) as running:
        for stack in shared_world.stack(scenes):
            calls = _Calls(ik_batch, count, stack, measure, mesh, chunk, memory)
            for cells, values in calls.results():
                for name, value in values.items():
                    if name not in results:
                        results[name] = np.zeros((count, len(scenes), *value.shape[1:]), dtype)
                    results[name][cells] = value
                done += len(cells[0])
                running.reach(done // len(scenes))
    return _from_all_processes(results)


@dataclasses.dataclass(frozen=True)
class _Calls:
    """The chunks of all systems on the clips of a stack: along systems, or along clips."""

    ik_batch: jaxik.FootIK
    count: int
    stack: shared_world.Stack
    measure: Measure
    mesh: Mesh
    chunk: int | None
    memory: float

    @property
    def along_clips(self) -> bool:
        """Whether a chunk is of clips, with one system, since there are more of them."""
        return len(self.stack.members) > self.count

    def results(self) -> Iterator[tuple[tuple[np.ndarray, np.ndarray], dict[str, np.ndarray]]]:
        """For each chunk the systems and clips to which its numbers belong, and the numbers."""
        size = self._size()
        outer = self.count if self.along_clips else len(self.stack.members)
        inner = len(self.stack.members) if self.along_clips else self.count
        chunks = list(itertools.product(range(outer), range(0, inner, size)))
        own = chunks[jax.process_index() :: jax.process_count()]
        together = usable_cores() if self.mesh.size == 1 else 1
        for first in range(0, len(own), together):
            wave = own[first : first + together]
            calls = [functools.partial(self._compute, *each, size) for each in wave]
            computed = on_all_cores(calls) if together > 1 else [call() for call in calls]
            for (fixed, start), values in zip(wave, computed, strict=True):
                present = np.arange(start, min(start + size, inner))
                members = np.asarray(self.stack.members)
                systems = np.full_like(present, fixed) if self.along_clips else present
                clips = members[present if self.along_clips else np.full_like(present, fixed)]
                yield (systems, clips), {k: v[: len(present)] for k, v in values.items()}

    def _compute(self, fixed: int, start: int, size: int) -> dict[str, np.ndarray]:
        """One chunk."""
        arguments = self.arguments(fixed, start, size)
        values = (self._by_kernel if self._has_kernel else _along)(*arguments)
        return {name: np.asarray(value) for name, value in values.items()}

    @property
    def _leg_frames(self) -> int:
        """How many there are, of all systems and clips."""
        frames, legs = self.stack.scenes.frames.weight.shape[-2:]
        return self.count * len(self.stack.members) * frames * legs

    @functools.cached_property
    def _has_kernel(self) -> bool:
        """Whether there is C code for it."""
        scene = self.stack.scenes
        if self.mesh.size > 1 or scene.frames.dt.dtype != np.float32:
            return False
        if scene.tracks or scene.size is not None or self._leg_frames < WORTH:
            return False
        _, _, stacked, ik, scene = self.arguments(0, 0, 1)
        try:
            kernel_of(*_of_run(stacked, ik, scene), keep=self._kept, checked=True)
        except NoKernelError:
            return False
        return True

    def _by_kernel(
        self,
        measure: Measure,
        mesh: Mesh,
        stacked: tuple[Stacked, Stacked],
        ik: jaxik.FootIK,
        scene: Scene,
    ) -> dict[str, Array]:
        """What `_along` gives, of what C code computes."""
        keep = self._kept
        kept = run_crowd(*_of_run(stacked, ik, scene), keep=keep, checked=True, cores=1)
        return _measured(measure, keep, stacked[1], scene, kept)

    @functools.cached_property
    def _kept(self) -> "_Leaves":
        """What the measure needs of a result."""
        system, scene = jax.tree.map(lambda leaf: leaf[0], self.ik_batch), self.stack.one(0)
        result = jax.eval_shape(run_scene, system, scene)
        leaves, structure = jax.tree.flatten(result)

        def of_leaves(leaves: list, scene: Scene) -> dict[str, Array]:
            return dict(self.measure(scene, jax.tree.unflatten(structure, leaves)))

        used = export.export(jax.jit(of_leaves))(leaves, scene).module_kept_var_idx
        numbers = tuple(number for number in used if number < len(leaves))
        shapes = tuple((leaf.shape, leaf.dtype.name) for leaf in leaves)
        return _Leaves(numbers, structure, shapes)

    def arguments(
        self, fixed: int, start: int, size: int
    ) -> tuple[Measure, Mesh, tuple[Stacked, Stacked], jaxik.FootIK, Scene]:
        """Those of `_along` for a chunk; the last one is filled up: all have one program."""
        if self.along_clips:
            systems, clips = fixed, self.stack.part(start, size)
            stacked: tuple[Stacked, Stacked] = (None, self.stack.stacked)
        else:
            systems = np.minimum(np.arange(start, start + size), self.count - 1)
            clips, stacked = self.stack.one(fixed), (self._varies, None)
        ik = shared_world.chosen(self.ik_batch, self._varies, systems)
        ik = shared_world.chosen(ik, [not flag for flag in self._varies], 0)
        return self.measure, self.mesh, stacked, ik, clips

    @functools.cached_property
    def _varies(self) -> tuple[bool, ...]:
        """Of each array of the systems, whether they differ in it; of one system, all do."""
        leaves = jax.tree.leaves(self.ik_batch)
        return tuple(len(leaf) > 1 or self.count == 1 for leaf in leaves)

    def _size(self) -> int:
        """Members of a chunk: as many for each device."""
        inner = len(self.stack.members) if self.along_clips else self.count
        devices = self.mesh.size
        if self.chunk is not None:
            wanted = self.chunk
        else:
            together = usable_cores() if devices == 1 else 1
            wanted = int(self.memory / (together * self._bytes_each()))
            if self.mesh.devices.flat[0].platform == "cpu":
                wanted = min(wanted, (BY_KERNEL if self._has_kernel else CACHED) * devices)
        wanted = max(1, min(wanted, math.ceil(inner / jax.process_count())))
        return math.ceil(wanted / devices) * devices

    def _bytes_each(self) -> float:
        """Bytes that a system on a clip takes while it is computed."""
        system, scene = jax.tree.map(lambda leaf: leaf[0], self.ik_batch), self.stack.one(0)
        shapes = jax.tree.leaves(jax.eval_shape(run_scene, system, scene))
        return WORKSPACE * sum(math.prod(x.shape) * x.dtype.itemsize for x in shapes)


def _of_run(
    stacked: tuple[Stacked, Stacked], ik: jaxik.FootIK, scene: Scene
) -> tuple[jaxik.FootIK, jaxik.Rig, Terrain, jaxik.Frame, Axes]:
    """The arguments of `run_crowd` for systems on a clip, or a system on clips."""
    of_ik, of_scene = (
        None if flags is None else shared_world.labelled(tree, flags, 0)
        for tree, flags in zip((ik, scene), stacked, strict=True)
    )
    of_parts: tuple[PyTree, PyTree, PyTree] = (None, None, None)
    if of_scene is not None:
        of_parts = (of_scene.rig, of_scene.terrain, of_scene.frames)
    return ik, scene.rig, scene.terrain, scene.frames, (of_ik, *of_parts)


@dataclasses.dataclass(frozen=True)
class _Leaves:
    """Takes some arrays of a frame's result, by their numbers."""

    numbers: tuple[int, ...]
    structure: PyTree
    """Of all arrays of a result."""
    shapes: tuple[tuple[tuple[int, ...], str], ...]
    """Of these of a clip, and their types."""

    def __call__(self, result: jaxik.Result) -> list[Array]:
        leaves = jax.tree.leaves(result)
        return [leaves[number] for number in self.numbers]

    def result(self, kept: Sequence[Array]) -> jaxik.Result:
        """The result of a clip, with zeros in place of the other arrays."""
        leaves = [jnp.zeros(*shape) for shape in self.shapes]
        for number, leaf in zip(self.numbers, kept, strict=True):
            leaves[number] = leaf
        return jax.tree.unflatten(self.structure, leaves)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _measured(
    measure: Measure, keep: _Leaves, stacked: Stacked, scene: Scene, kept: list[Array]
) -> dict[str, Array]:
    """The measures of results, of which only some arrays are there."""

    def of_one(scene: Scene, kept: list[Array]) -> dict[str, Array]:
        return dict(measure(scene, keep.result(kept)))

    of_scene = None if stacked is None else shared_world.labelled(scene, stacked, 0)
    return lanes(of_one, in_axes=(of_scene, 0))(scene, kept)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _along(
    measure: Measure,
    mesh: Mesh,
    stacked: tuple[Stacked, Stacked],
    ik: jaxik.FootIK,
    scene: Scene,
) -> dict[str, Array]:
    """The measures of systems on a clip, or of a system on clips, shared out among devices.

    `stacked` says which arrays of system and clip have an axis of the batch; None for none.
    """
    arguments = tuple(zip((ik, scene), stacked, strict=True))
    in_axes = tuple(flags and shared_world.labelled(tree, flags, 0) for tree, flags in arguments)
    split = PartitionSpec(BATCH)
    specs = tuple(
        shared_world.labelled(tree, flags, split, EVERYWHERE) if flags else EVERYWHERE
        for tree, flags in arguments
    )

    def measured(ik: jaxik.FootIK, scene: Scene) -> dict[str, Array]:
        return dict(measure(scene, run_scene(ik, scene)))

    # Unchecked: loops of the pipeline begin with constants, which are the same everywhere.
    return jax.shard_map(
        lanes(measured, in_axes=in_axes),
        mesh=mesh,
        in_specs=specs,
        out_specs=split,
        check_vma=False,
    )(ik, scene)


def _scenes(clips: Experiment | str | Path | Sequence[Scene]) -> Sequence[Scene]:
    if isinstance(clips, str | Path):
        clips = load_experiment(clips)
    scenes = make_problem(clips).data if isinstance(clips, Experiment) else clips
    if not len(scenes):
        raise ValueError("no clips; wanted one or more")
    return scenes


def _batch_size(ik_batch: jaxik.FootIK) -> int:
    """How many systems there are."""
    shapes = [np.shape(leaf) for leaf in jax.tree.leaves(ik_batch)]
    if not all(shapes):
        raise ValueError(
            "an array of the systems has no axis for them; fitting.vary and jax.vmap make batches"
        )
    sizes = {shape[0] for shape in shapes} - {1}
    if len(sizes) > 1:
        raise ValueError(f"the systems' arrays are of {sorted(sizes)} systems; wanted one number")
    return sizes.pop() if sizes else 1


def _from_all_processes(results: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The results of all processes: each has zeros where others computed."""
    if jax.process_count() == 1:
        return results
    from jax.experimental import multihost_utils

    gathered = multihost_utils.process_allgather(results)
    return {name: np.sum(np.asarray(value), axis=0) for name, value in gathered.items()}
