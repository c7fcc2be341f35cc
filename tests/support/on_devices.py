"""What several devices, or processes, compute of two short clips: `python -m support.on_devices`.

Arguments: the file for the numbers, the number of simulated devices and, for several processes, the
address of the first one, their number, and which of them this is.
"""

import contextlib
import dataclasses
import os
import sys
from collections.abc import Iterator
from unittest import mock

import numpy as np

SYSTEMS = 13  # no multiple of any number of devices or chunks
CHUNK = 5


def main() -> None:
    """Computes errors and log-probabilities, and writes them."""
    path, devices, *processes = sys.argv[1:]
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={devices}"
    import jax

    jax.config.update("jax_enable_x64", True)
    if processes:
        address, count, number = processes
        jax.distributed.initialize(address, int(count), int(number))
    found = evaluations("systems") if processes else evaluations() | log_probabilities()
    np.savez(path, allow_pickle=False, **found)


def make_problem():
    """Of three clips, each of which runs alone."""
    from fitting.experiment import problems
    from support.scenes import experiment

    problem = problems.make_problem(experiment())
    scenes = [dataclasses.replace(scene, place=None) for scene in problem.data]
    return dataclasses.replace(problem, data=tuple(scenes))


def invented_errors(scene, ik):
    """Of a system that only follows the pelvis: with a loop from a constant, as the real one."""
    import jax
    import jax.numpy as jnp

    def step(place, target):
        place = place + ik.pelvis.half_life * (target - place)
        return place, place

    reference, zero = scene.reference, jnp.zeros(3, scene.frames.dt.dtype)
    _, place = jax.lax.scan(step, zero, scene.frames.world_from_model.pos)
    ankle = reference.ankle.pos - place[:, None]
    return {
        "ankle": ankle,
        "knee": reference.knee_ws - place[:, None],
        "pelvis": reference.pelvis.pos - place,
        "foot": 2.0 * ankle,
        "body": place,
        "contact": reference.contact - ik.foot.max_pitch,
        "smooth": jnp.diff(ankle, n=2, axis=0),
    }


@contextlib.contextmanager
def invented_pipeline() -> Iterator[None]:
    """Programs that compile at once; no others of the same types are used instead."""
    import jax

    from fitting.problem import residuals
    from fitting.studies.many import evaluation

    changes = {"run_scene": lambda ik, scene: ik, "errors_by_kind": invented_errors}
    jax.clear_caches()
    with mock.patch.multiple(residuals, **changes), mock.patch.multiple(evaluation, **changes):
        yield
    jax.clear_caches()


@invented_pipeline()
def evaluations(*kinds: str) -> dict[str, np.ndarray]:
    """Errors of many `systems` on clips, and of one system on all `clips` at once."""
    import fitting

    problem = make_problem()
    ik = problem.space.unpack(problem.space.start)
    found = {}
    for kind in kinds or ("systems", "clips"):
        half_lives = np.linspace(0.05, 0.9, SYSTEMS) if kind == "systems" else [0.2]
        batch = fitting.vary(ik, {"pelvis.half_life": half_lives})
        chunk = CHUNK if kind == "systems" else 2
        values = fitting.evaluate_many(batch, problem.data, chunk=chunk)
        found |= {f"{kind} {name}": value for name, value in values.items()}
    return found


@invented_pipeline()
def log_probabilities() -> dict[str, np.ndarray]:
    """Of two points, with the sigmas that are given and with open ones; minus twice, and of the
    latter without the prior."""
    import jax
    import jax.numpy as jnp

    from fitting.inference.noise import with_unknown_sigmas
    from fitting.inference.sharding import over_devices

    given = make_problem()
    sharded, opened = over_devices(given), over_devices(with_unknown_sigmas(given))
    assert (sharded is given) == (jax.local_device_count() == 1)
    found = []
    for u in np.random.default_rng(0).normal(0.0, 0.3, (2, given.space.size)):
        residuals = sharded.residuals(jnp.asarray(u))  # of both, in the same order
        assert opened.unknown_sigmas is not None
        of_data = residuals[: -given.space.size] ** 2
        marginal = opened._marginal(of_data, opened.unknown_sigmas)
        found.append([jnp.sum(residuals**2), marginal])
    return {"log-probability": np.array(found)}


if __name__ == "__main__":
    main()
