"""A posterior for ArviZ: its plots, its diagnostics and NetCDF files.

ArviZ is optional; `pip install "jaxik[posterior]"` installs it.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from fitting.problem.space import Space
from fitting.runtime.files import check_seal, write_sealed
from fitting.runtime.json_files import check_version
from fitting.runtime.precision import in_float64
from fitting.runtime.validation import in_one_line
from jaxik.maths import parameter_tree

from . import blocks
from .posterior import Posterior

PRIOR_DRAWS = 4000
FORMAT = 1
# What xarray and its engine raise for a damaged file.
UNREADABLE = (OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError)


def _check_available() -> None:
    if not blocks.is_available():
        raise ImportError('this needs ArviZ: pip install "jaxik[posterior]"')


def read_blocks(path: Path) -> blocks.BlockLogLikelihood:
    """The log-likelihood of blocks that a NetCDF file holds.

    Raises:
        ImportError: ArviZ is not installed.
        ValueError: the file holds none.
    """
    _check_available()
    import xarray

    try:
        check_seal(path)
        with xarray.open_datatree(path, engine="h5netcdf") as tree:
            version = int(tree.attrs.get("format", 0))
            stored = blocks.from_tree(tree)
    except UNREADABLE as error:
        raise ValueError(
            f"{path}: no log-likelihood in it: {in_one_line(error)}; `jaxik sample` writes it"
        ) from None
    check_version(path, version, FORMAT)
    return stored


@in_float64
def to_inference_data(posterior: Posterior, space: Space) -> Any:
    """Draws of posterior and prior as ArviZ's `DataTree` (`InferenceData` in its 0.x).

    Groups: `posterior` and `prior` hold a variable for each parameter under its dotted name, in its
    unit, with `units` and `kind` as attributes; `sample_stats` holds the log-probability as `lp`.
    `log_likelihood`, where the posterior has it, holds that of the captured `motion` for some draws
    and each `block` of frames, as `arviz_stats.loo` takes it; `clip`, `start` and `end` say which.
    Coordinates: `chain`, the walker's index, and `draw`, the step of the sampler, so that burn-in
    and isolated walkers are seen to be missing. Walkers exchange proposals, but ArviZ treats them
    as independent chains: its effective sample sizes are too large; ours are in the summary.

    Args:
        posterior: the samples.
        space: of the problem that was sampled.

    Raises:
        ImportError: ArviZ is not installed.
    """
    _check_available()
    from arviz_base import from_dict

    declared = parameter_tree.declarations(space.system)
    attributes = {
        p.name: {"units": declared[p.leaf].unit, "kind": p.kind} for p in space.parameters
    }
    u = space.prior.draw(np.random.default_rng(0), PRIOR_DRAWS)
    drawn = np.asarray(space.values(u))
    log_probability = np.delete(
        posterior.log_probability[posterior.burn_in :], posterior.isolated, axis=1
    )
    names = posterior.names
    groups = {
        "posterior": {name: posterior.draws[..., i].T for i, name in enumerate(names)},
        "sample_stats": {"lp": log_probability.T},
        "prior": {name: drawn[None, :, i] for i, name in enumerate(names)},
    }
    of_all = {"inference_library": "emcee", "message": posterior.message, "format": FORMAT}
    with warnings.catch_warnings():  # a young chain has fewer steps than walkers
        warnings.filterwarnings("ignore", "Found chain dimension to be longer than draw")
        tree = from_dict(groups, attrs={"/": of_all})
    walkers = np.delete(np.arange(posterior.u.shape[1]), posterior.isolated)
    steps = posterior.thin_by * (1 + np.arange(posterior.burn_in, len(posterior.u)))
    for group in ("posterior", "sample_stats"):
        tree[group].dataset = tree[group].to_dataset().assign_coords(chain=walkers, draw=steps)
    if posterior.blocks is not None:
        tree["log_likelihood"] = blocks.to_tree(posterior.blocks)["log_likelihood"]
    for group in ("posterior", "prior"):
        for name in names:
            tree[group][name].attrs.update(attributes[name])
    return tree


def write_inference_data(path: Path, posterior: Posterior, space: Space) -> None:
    """Writes `to_inference_data` as a NetCDF file, which `arviz.from_netcdf` reads.

    Raises:
        ImportError: ArviZ is not installed.
    """
    write_sealed(path, to_inference_data(posterior, space).to_netcdf(engine="h5netcdf"))
