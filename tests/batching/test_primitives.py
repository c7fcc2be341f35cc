"""What `lanes` depends on in JAX's traces, which JAX may change; this file says where it did.

A primitive or a parameter that JAX renames makes `lanes` slower, not wrong: its equations go
through `jax.vmap`. Here the programs of the pipeline are traced, and primitives that do are named.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from batching.test_lanes import CASES, assert_same, numbers
from fitting.bench import workloads
from jaxik import lanes
from jaxik.batching import primitives

# JAX's own rules leave the batch axis where it is, or an example reads a place of its own.
MAPPED_BY_JAX = {"dynamic_slice", "pad", "slice"}


@pytest.fixture
def mapped_by_jax(monkeypatch):
    """Names of the primitives that went through `jax.vmap`."""
    names = set()
    vmap = primitives.BatchEvaluator._vmap

    def recorded(evaluator, equation, values):
        names.add(equation.primitive.name)
        return vmap(evaluator, equation, values)

    monkeypatch.setattr(primitives.BatchEvaluator, "_vmap", recorded)
    return names


@pytest.mark.slow
def test_the_pipeline_has_rules_for_its_primitives_in_the_installed_jax(mapped_by_jax):
    problem = workloads.problem(16, workloads.parameter_names(20))
    jax.make_jaxpr(problem.residuals_and_jacobian)(problem.space.start)
    jax.make_jaxpr(lanes(problem.log_probability))(jnp.stack([problem.space.start] * 2))
    assert mapped_by_jax <= MAPPED_BY_JAX, f"JAX {jax.__version__} changed {mapped_by_jax}"


def assert_results_stay(names):
    """That these cases by lanes, with the present rules, are as by vmap."""
    mapped = jax.jit(lambda x: [{n: way(CASES[n])(x) for n in names} for way in (lanes, jax.vmap)])
    assert_same(*mapped(numbers(5, 3)))


@pytest.mark.parametrize("primitive", ["scan", "jit", "custom_jvp_call", "broadcast_in_dim"])
def test_results_stay_when_jax_changes_a_primitive(primitive, monkeypatch, mapped_by_jax):
    renamed = dict(primitives.RULES)
    _, rule = renamed.pop(primitive)
    for rules in (renamed, renamed | {primitive: ("of_tomorrow", rule)}):
        monkeypatch.setattr(primitives, "RULES", rules)
        mapped_by_jax.clear()
        assert_results_stay(("rotations", "a scan", "a custom derivative"))
        assert primitive in mapped_by_jax


def test_results_stay_without_any_rule(monkeypatch):
    monkeypatch.setattr(primitives, "RULES", {})
    assert_results_stay(("rotations", "a scan", "a custom derivative", "a conditional"))


def test_a_rule_reads_parameters_that_its_primitive_has():
    x = np.ones((3, 2), np.float32)
    trace = jax.make_jaxpr(lambda x: jax.lax.scan(lambda c, y: (c + y, y), x[0], x))(x)
    scans = [equation for equation in trace.eqns if equation.primitive.name == "scan"]
    reads, _ = primitives.RULES["scan"]
    assert set(reads.split()) <= scans[0].params.keys()
