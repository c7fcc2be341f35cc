"""What several devices, or processes, compute of two short clips: `python -m support.on_devices`.

Arguments: the file for the numbers, the number of simulated devices and, for several processes, the
address of the first one, their number, and which of them this is.
"""

import dataclasses
import os
import sys

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
    """Of three clips on a plane, for which programs compile sooner than for their ground."""
    from fitting.experiments import problems
    from fitting.problem.shared_world import share_world
    from jaxik.world.terrain import plane
    from support.scenes import experiment

    problem = problems.make_problem(experiment())
    ground = plane()
    scenes = [dataclasses.replace(scene, terrain=ground, place=None) for scene in problem.data]
    placed = tuple(share_world(scenes, problem.space.system.probe))
    return dataclasses.replace(problem, data=placed)


def evaluations(*kinds: str) -> dict[str, np.ndarray]:
    """Errors of many `systems` on clips, and of one system on all `clips` at once."""
    import fitting

    problem = make_problem()
    ik = problem.space.unpack(problem.space.start)
    found = {}
    for kind in kinds or ("systems", "clips"):
        gains = np.linspace(0.05, 0.9, SYSTEMS) if kind == "systems" else [0.2]
        batch = fitting.vary(ik, {"pelvis.on_gain": gains})
        chunk = CHUNK if kind == "systems" else 2
        values = fitting.evaluate_many(batch, problem.data, chunk=chunk)
        found |= {f"{kind} {name}": value for name, value in values.items()}
    return found


def log_probabilities() -> dict[str, np.ndarray]:
    """Log-probabilities of two points, with the sigmas that are given and with open ones."""
    import jax
    import jax.numpy as jnp

    from fitting.inference.noise.marginal import with_unknown_sigmas
    from fitting.inference.sharding import over_devices

    given = make_problem()
    sharded, opened = over_devices(given), over_devices(with_unknown_sigmas(given))
    assert (sharded is given) == (jax.local_device_count() == 1)
    found = []
    for u in np.random.default_rng(0).normal(0.0, 0.3, (2, given.space.size)):
        residuals = sharded.residuals(jnp.asarray(u))  # of both, in the same order
        assert opened.unknown_sigmas is not None
        marginal = opened._log_marginal(residuals, opened.unknown_sigmas)
        found.append([-0.5 * jnp.sum(residuals**2), marginal])
    return {"log-probability": np.array(found)}


if __name__ == "__main__":
    main()
