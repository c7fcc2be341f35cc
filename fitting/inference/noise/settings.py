"""Which properties of the noise are estimated, and what for."""

import dataclasses
from typing import Literal, get_args

Sigmas = Literal["given", "estimated"]
Correlation = Literal["given", "whitened", "counted"]


@dataclasses.dataclass(frozen=True)
class NoiseOptions:
    """Which properties of the noise are estimated from the residuals, kind by kind.

    By default the best point is where the residuals in units of the given sigmas are smallest, and
    what is estimated only decides how wide intervals are. Estimated sigmas and whitened residuals
    move the best point: right for noise that the system leaves, and wrong for what it cannot
    follow, which then counts as noise. The tails of the loss `student` are estimated together with
    the sigmas.

    Raises:
        ValueError: for an unknown word.
    """

    sigmas: Sigmas = "given"
    correlation: Correlation = "counted"
    """Estimated, and residuals counted as fewer, or more, as their correlation and their size say;
    or estimated and taken out of the residuals (whitened)."""

    def __post_init__(self) -> None:
        for name, words in (("sigmas", Sigmas), ("correlation", Correlation)):
            if (word := getattr(self, name)) not in get_args(words):
                raise ValueError(f"{name} is {word!r}; wanted one of {list(get_args(words))}")

    @property
    def moves_optimum(self) -> bool:
        """Whether what is estimated decides where the best point is."""
        return self.sigmas == "estimated" or self.correlation == "whitened"

    @property
    def estimates_any(self) -> bool:
        """Whether anything is estimated."""
        return self.moves_optimum or self.correlation == "counted"
