"""Which properties of the noise are estimated."""

import dataclasses
from typing import Literal, get_args

Sigmas = Literal["given", "estimated"]
Correlation = Literal["given", "whitened", "counted"]


@dataclasses.dataclass(frozen=True)
class NoiseOptions:
    """Which properties of the noise are estimated from the residuals, kind by kind.

    The tails of the loss `student` are estimated together with the sigmas.

    Raises:
        ValueError: for an unknown word.
    """

    sigmas: Sigmas = "given"
    correlation: Correlation = "given"
    """Estimated and taken out of the residuals (whitened); or estimated, and residuals counted as
    fewer."""

    def __post_init__(self) -> None:
        for name, words in (("sigmas", Sigmas), ("correlation", Correlation)):
            if (word := getattr(self, name)) not in get_args(words):
                raise ValueError(f"{name} is {word!r}; wanted one of {list(get_args(words))}")

    @property
    def estimates_any(self) -> bool:
        """Whether anything is estimated."""
        return (self.sigmas, self.correlation) != ("given", "given")


GIVEN = NoiseOptions()
