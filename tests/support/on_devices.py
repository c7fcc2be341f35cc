"""What several devices, or processes, compute of two short clips: `python -m support.on_devices`.

Arguments: the file for the numbers, the number of simulated devices and, for several processes, the
address of the first one, their number, and which of them this is.
"""

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


def evaluations(*kinds: str) -> dict[str, np.ndarray]:
    """Errors of many `systems` on clips, and of one system on all `clips` at once."""
    import fitting
    from fitting.experiments.problems import make_problem
    from support.scenes import experiment

    problem = make_problem(experiment())
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
    """Log-probabilities of a few points, with the sigmas that are given and with open ones."""
    import jax
    import jax.numpy as jnp

    from fitting.experiments.problems import make_problem
    from fitting.inference.noise.marginal import with_unknown_sigmas
    from fitting.inference.sharding import over_devices
    from support.scenes import experiment

    problem = make_problem(experiment())
    u = jnp.asarray(np.random.default_rng(0).normal(0.0, 0.3, (4, problem.space.size)))
    found = {}
    for name, of in (("given", problem), ("open", with_unknown_sigmas(problem))):
        sharded = over_devices(of)
        assert (sharded is of) == (jax.local_device_count() == 1)
        found[f"log-probability {name}"] = np.array([sharded.log_probability(row) for row in u])
    return found


if __name__ == "__main__":
    main()
