"""A digest of a problem: whether two searches or chains are of the same one."""

import dataclasses
import hashlib

import equinox as eqx
import jax
import numpy as np

from .problem import Problem


def digest(problem: Problem) -> str:
    """64 characters that change with any number or name on which the log-probability depends."""
    problem = eqx.tree_at(lambda problem: problem.space.start, problem, replace=None)
    digested = hashlib.sha256()
    function = problem.residual_function
    names = (function.__module__, function.__qualname__, problem.loss)
    parameters = [dataclasses.astuple(parameter) for parameter in problem.space.parameters]
    digested.update(repr((names, parameters)).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(eqx.filter(problem, eqx.is_array_like)):
        name = jax.tree_util.keystr(path)
        if ".place." in name:  # in a shared world, which changes no number
            continue
        array = np.asarray(leaf)
        digested.update(f"{name} {array.dtype} {array.shape}".encode())
        digested.update(array.tobytes())
    return digested.hexdigest()


def digest_with(problem: Problem, *settings: object) -> str:
    """64 characters that also change with anything else that a search follows from."""
    start = np.asarray(problem.space.start).tolist()
    return hashlib.sha256(f"{digest(problem)} {(*settings, start)}".encode()).hexdigest()
