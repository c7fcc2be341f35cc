"""How long a chain is sampled and how often it is checked."""

import dataclasses

from fitting.inference.settings import Settings, setting

MAX_CHAIN = 2**33  # bytes of a chain, all of whose stored steps are held in memory


@dataclasses.dataclass(frozen=True)
class SamplerSettings(Settings):
    """Settings of `posterior.sample_posterior`.

    Raises:
        ValueError: for a setting out of its range.
    """

    walkers: int | None = setting(
        None, "Walkers: an even number, by default four per free parameter.", low=1, high=10_000
    )
    max_steps: int = setting(
        20_000,
        "Steps of the sampler at most, over all runs of a chain.",
        unit="steps",
        low=1,
        high=10**9,
    )
    min_steps: int = setting(
        0, "Steps before which sampling does not stop.", unit="steps", high=10**9
    )
    thin_by: int = setting(1, "One step in so many is stored.", unit="steps", low=1, high=10**6)
    check_every: int = setting(
        100, "Steps between reports, and at least between checks of convergence.", low=1, high=10**6
    )
    stop_at: float = setting(
        50.0,
        "Length that ends the sampling, if the time is steady.",
        unit="autocorrelation times",
        high=1e12,
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
