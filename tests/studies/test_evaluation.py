"""Many systems on many clips: the numbers of each, in chunks, by one program."""

import jax
import numpy as np
import pytest

import fitting
import jaxik
from fitting.experiments.problems import make_problem
from fitting.problem.scene import Scene
from fitting.problem.shared_world import run_scene
from fitting.studies.many import evaluation
from jaxik.maths import parameter_tree
from support import scenes

GAINS = np.linspace(0.05, 0.9, 5)
COST = "cost"


@pytest.fixture(scope="module")
def problem():
    return make_problem(scenes.experiment())


@pytest.fixture(scope="module")
def ik(problem):
    return problem.space.unpack(problem.space.start)


def test_each_system_and_clip_has_the_cost_of_its_residuals(problem, ik):
    batch = fitting.vary(ik, {"pelvis.on_gain": GAINS})
    found = fitting.evaluate_many(batch, problem.data, chunk=2)
    assert {values.shape for values in found.values()} == {(5, 3)}
    one = parameter_tree.replace(ik, {"pelvis.on_gain": GAINS[3]})
    residuals = problem.residual_function(one, problem.data)
    assert found[COST][3].sum() == pytest.approx(0.5 * float(np.sum(residuals**2)), rel=1e-10)
    scene = problem.data[1]
    alone = run_scene(one, scene)
    errors = np.asarray(evaluation.errors_by_kind(scene, alone)["pelvis"])
    seen = np.asarray(scene.reference.observed)
    expected = np.sqrt(np.mean(errors[seen] ** 2, axis=0).sum())
    assert found["pelvis"][3, 1] == pytest.approx(expected, rel=1e-10)


traced: list[int] = []  # frames of the clips for which `cost` was traced


def cost(scene: Scene, result: jaxik.Result) -> dict[str, jax.Array]:
    """The cost; says that a program is compiled for it."""
    traced.append(scene.frames.dt.shape[-1])
    return {COST: evaluation.errors_and_cost(scene, result)[COST]}


def test_no_chunk_and_no_second_call_compiles_anew(problem, ik):
    batch = fitting.vary(ik, {"pelvis.on_gain": GAINS})
    fitting.evaluate_many(batch, problem.data, cost, chunk=2)
    before = len(traced)
    assert before >= 1
    fitting.evaluate_many(batch, problem.data, cost, chunk=2)
    more = fitting.vary(ik, {"pelvis.on_gain": np.linspace(0.1, 0.8, 7)})
    found = fitting.evaluate_many(more, problem.data, cost, chunk=2)
    assert len(traced) == before
    assert found[COST].shape == (7, 3)


def calls_of(ik, scenes, systems: int, chunk: int | None, memory: float) -> evaluation._Calls:
    """What evaluates so many systems on clips of one length."""
    batch = fitting.vary(ik, {"pelvis.on_gain": np.linspace(0.1, 0.8, systems)})
    mesh = jax.sharding.Mesh(np.array(jax.local_devices()), (evaluation.BATCH,))
    (stack,) = evaluation.stacking.stack(scenes)
    arrays, measure = jax.tree.map(np.asarray, batch), evaluation.errors_and_cost
    return evaluation._Calls(arrays, systems, stack, measure, mesh, chunk, memory)


def test_a_chunk_follows_from_the_memory_that_it_may_take(problem, ik):
    def size(chunk: int | None, memory: float) -> int:
        return calls_of(ik, problem.data, 1000, chunk, memory)._size()

    assert size(None, 0.0) == 1 and size(None, 1e15) == evaluation.CACHED
    assert 1 < size(None, 1e7) < size(None, 5e7) <= evaluation.CACHED
    assert size(10, 0.0) == 10 and size(5000, 0.0) == 1000


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize(("systems", "clips"), [(16, 1), (1, 16)])
def test_a_chunk_takes_no_more_memory_than_reckoned(problem, ik, systems, clips):
    calls = calls_of(ik, problem.data * clips, systems, 16, 1.0)
    memory = evaluation._along.lower(*calls.arguments(0, 0, 16)).compile().memory_analysis()
    assert memory is not None
    taken = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    assert 0.1 * 16 * calls._bytes_each() < taken < 16 * calls._bytes_each()


def test_mistakes_are_told(problem, ik):
    with pytest.raises(ValueError, match="an array of the systems has no axis for them"):
        fitting.evaluate_many(ik, problem.data)
    batch = fitting.vary(ik, {"pelvis.on_gain": GAINS})
    with pytest.raises(ValueError, match="no clips; wanted one or more"):
        fitting.evaluate_many(batch, ())
    with pytest.raises(ValueError, match="chunk is 0; wanted 1 or more"):
        fitting.evaluate_many(batch, problem.data, chunk=0)
    with pytest.raises(ValueError, match="wanted the same number of each"):
        fitting.vary(ik, {"pelvis.on_gain": GAINS, "pelvis.limit": GAINS[:3]})
    with pytest.raises(ValueError, match="no parameter named 'pelvis.wings'"):
        fitting.vary(ik, {"pelvis.wings": GAINS})
