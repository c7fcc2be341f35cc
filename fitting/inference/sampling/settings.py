"""How long a chain is sampled and how often it is checked."""

import dataclasses

from fitting.inference.settings import Settings, setting


@dataclasses.dataclass(frozen=True)
class SamplerSettings(Settings):
    """Settings of `posterior.sample_posterior`.

    Raises:
        ValueError: for a setting out of its range.
    """

    walkers: int | None = setting(
        None, "Walkers: an even number, by default four per free parameter.", low=1
    )
    max_steps: int = setting(
        20_000, "Steps of the sampler at most, over all runs of a chain.", unit="steps", low=1
    )
    min_steps: int = setting(0, "Steps before which sampling does not stop.", unit="steps")
    thin_by: int = setting(1, "One step in so many is stored.", unit="steps", low=1)
    check_every: int = setting(
        100, "Steps between reports, and at least between checks of convergence.", low=1
    )
    stop_at: float = setting(
        50.0, "Length that ends the sampling, if the time is steady.", unit="autocorrelation times"
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
            ValueError: for an odd number, or fewer than two per free parameter.
        """
        if self.walkers is None:
            return max(4 * size, 4)
        minimum = max(4, 2 * size)
        if self.walkers % 2 or self.walkers < minimum:
            raise ValueError(
                f"walkers is {self.walkers}, wanted an even number from {minimum} on,"
                " two per free parameter"
            )
        return self.walkers


DEFAULTS = SamplerSettings()
