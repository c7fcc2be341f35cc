"""The log-likelihood of blocks of frames, and predictions of blocks that are left out.

Leaving out one block after another shows how well a fit predicts motion that it has not seen. The
chain is not sampled again: its draws are weighted (Pareto-smoothed importance sampling; Vehtari,
Gelman and Gabry 2017). Blocks, and not frames, because a frame is known from its neighbours.
"""

import dataclasses
import importlib.util
import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from fitting.runtime.declarations import Table, key

# s, of a block. A step of a walk takes about half of it, and errors that come with a step hardly
# last beyond the next one. The same for every fit, so that fits can be compared.
SECONDS = 1.0
MIN_DRAWS = 100  # for the tail of the weights
PACKAGES = ("arviz_base", "arviz_stats", "xarray", "h5netcdf")

MAX_CHAIN = 2**33  # bytes of a chain, all of whose stored steps are held in memory


@dataclass(frozen=True)
class BlockLogLikelihood:
    """The log-likelihood of blocks of frames for some draws of a posterior."""

    values: Float[np.ndarray, "draws blocks"]
    """Constants included, so that fits with other sigmas or losses can be compared."""
    clip: Int[np.ndarray, " blocks"]
    """From 1."""
    start: Float[np.ndarray, " blocks"]
    """Seconds from the beginning of the clip."""
    end: Float[np.ndarray, " blocks"]
    data: str
    """Digest of the captured motion and of the frames that count."""
    efficiency: float
    """Effective draws for each draw."""


@dataclass(frozen=True)
class LeaveOneOut:
    """How well a posterior predicts each block from the others."""

    elpd: float
    """Expected log predictive density of all blocks."""
    error: float
    """Its standard error."""
    parameters: float
    """Effective number of parameters."""
    elpd_of_block: Float[np.ndarray, " blocks"]
    pareto_k: Float[np.ndarray, " blocks"]
    """Shape of each block's weights."""
    max_k: float
    """Above it, a block's figure is unreliable."""
    neighbours: float
    """Correlation of blocks with the next one in their clip; NaN where there are few."""

    @property
    def unreliable(self) -> int:
        """Number of blocks whose figure is unreliable."""
        return int(np.sum(~(self.pareto_k <= self.max_k)))


def is_available() -> bool:
    """Whether ArviZ and the packages with which it writes files are installed."""
    return all(map(importlib.util.find_spec, PACKAGES))


def to_tree(blocks: BlockLogLikelihood) -> Any:
    """The log-likelihood alone, for ArviZ: one chain, a `block` for each observation."""
    from arviz_base import from_dict

    tree = from_dict(
        {"log_likelihood": {"motion": blocks.values[None]}},
        dims={"motion": ["block"]},
    )
    group = tree["log_likelihood"]
    group.attrs.update(data=blocks.data, efficiency=blocks.efficiency)
    coordinates = {name: ("block", getattr(blocks, name)) for name in ("clip", "start", "end")}
    group.dataset = group.to_dataset().assign_coords(coordinates)
    return tree


def from_tree(tree: Any) -> BlockLogLikelihood:
    """The log-likelihood that a tree holds.

    Raises:
        KeyError: it holds none.
        ValueError: its numbers are not finite.
    """
    motion = tree["log_likelihood"]["motion"]
    stored = BlockLogLikelihood(
        values=motion.values.reshape(-1, motion.sizes["block"]),
        clip=motion["clip"].values,
        start=motion["start"].values,
        end=motion["end"].values,
        data=str(tree["log_likelihood"].attrs["data"]),
        efficiency=float(tree["log_likelihood"].attrs["efficiency"]),
    )
    for name in ("values", "clip", "start", "end", "efficiency"):
        if not np.isfinite(getattr(stored, name)).all():
            raise ValueError(f"{name} has numbers that are not finite")
    return stored


def leave_one_out(blocks: BlockLogLikelihood) -> LeaveOneOut | None:
    """How well each block is predicted from the others.

    None without ArviZ, with fewer than two blocks or with fewer than `MIN_DRAWS` draws.
    """
    if not is_available() or len(blocks.clip) < 2 or len(blocks.values) < MIN_DRAWS:
        return None
    from arviz_stats.loo import loo

    with warnings.catch_warnings(action="ignore"):  # of unreliable blocks, which are counted below
        estimate: Any = loo(to_tree(blocks), pointwise=True, reff=blocks.efficiency)
    elpd_of_block = np.asarray(estimate.elpd_i)
    return LeaveOneOut(
        elpd=float(estimate.elpd),
        error=float(estimate.se),
        parameters=float(estimate.p),
        elpd_of_block=elpd_of_block,
        pareto_k=np.asarray(estimate.pareto_k),
        max_k=float(estimate.good_k),
        neighbours=_neighbours(elpd_of_block, blocks.clip),
    )


def _neighbours(values: np.ndarray, clip: np.ndarray) -> float:
    """Correlation of each value with the next one of the same clip."""
    follows = clip[1:] == clip[:-1]
    if follows.sum() < 3:
        return math.nan
    before, after = values[:-1][follows], values[1:][follows]
    if not (before.std() and after.std()):
        return math.nan
    return float(np.corrcoef(before, after)[0, 1])


@dataclasses.dataclass(frozen=True)
class SamplerSettings(Table):
    """Settings of `posterior.sample_posterior`.

    Raises:
        ValueError: for a setting out of its range.
    """

    walkers: int | None = key(
        None, "Walkers: an even number, by default four per free parameter.", "", 1, 10_000
    )
    max_steps: int = key(
        20_000, "Steps of the sampler at most, over all runs of a chain.", "steps", 1, 10**9
    )
    min_steps: int = key(0, "Steps before which sampling does not stop.", "steps", 0, 10**9)
    thin_by: int = key(1, "One step of this many is stored.", "steps", 1, 10**6)
    check_every: int = key(
        100, "Steps between reports, and at least between checks of convergence.", "", 1, 10**6
    )
    stop_at: float = key(
        50.0,
        "Length that ends the sampling, if the time is steady.",
        "autocorrelation times",
        0,
        1e12,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_steps < self.thin_by:
            raise ValueError(
                f"max_steps is {self.max_steps}, wanted at least thin_by, which is {self.thin_by}"
            )

    def walkers_for(self, size: int) -> int:
        """Number of walkers for `size` free parameters.

        Raises:
            ValueError: for an odd number, fewer than two per free parameter, or a chain that is too
                large for memory.
        """
        minimum = max(4, 2 * size)
        walkers = max(4 * size, 4) if self.walkers is None else self.walkers
        if walkers % 2 or walkers < minimum:
            raise ValueError(
                f"walkers is {walkers}, wanted an even number from {minimum} on,"
                " two per free parameter"
            )
        stored = self.max_steps // self.thin_by
        if (needed := 8 * stored * walkers * size) > MAX_CHAIN:
            raise ValueError(
                f"max_steps is {self.max_steps}, of which {stored} are stored: with {walkers} "
                f"walkers and {size} parameters {needed / 2**30:.3g} GiB, wanted at most "
                f"{MAX_CHAIN / 2**30:g}; take a larger thin_by"
            )
        return walkers


DEFAULTS = SamplerSettings()
