"""Which clips have the value of a parameter in common."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

SHARED = -1  # the group of every clip, for a parameter that all clips have in common


@dataclasses.dataclass(frozen=True)
class Grouping:
    """The group that each clip belongs to, for each parameter."""

    group: Int[np.ndarray, "clips parameters"]
    """From 0 for each parameter that varies; `SHARED` for the others."""

    @classmethod
    def of_labels(cls, labels: Sequence[Sequence[str] | None]) -> "Grouping":
        """The grouping in which clips with the same label share a value.

        Args:
            labels: for each parameter the labels of all clips, or None if they share it.

        Raises:
            ValueError: all labels are None, so that the number of clips is not known.
        """
        counts = {len(each) for each in labels if each is not None}
        if len(counts) != 1:
            raise ValueError(f"wanted a label for each clip, got {sorted(counts)} of them")
        columns = [
            np.full(next(iter(counts)), SHARED) if each is None else _numbered(each)
            for each in labels
        ]
        return cls(np.stack(columns, axis=1))

    @classmethod
    def pooled(cls, clips: int, parameters: int) -> "Grouping":
        """The grouping in which all clips share everything."""
        return cls(np.full((clips, parameters), SHARED))

    @property
    def varying(self) -> tuple[int, ...]:
        """Indices of the parameters that are not shared."""
        return tuple(np.flatnonzero((self.group != SHARED).any(axis=0)).tolist())

    @property
    def counts(self) -> Int[np.ndarray, " parameters"]:
        """The number of groups of each parameter; 0 where shared."""
        return self.group.max(axis=0) + 1

    def without(self, clip: int) -> "Grouping":
        """The grouping of the other clips; groups that have none left are gone."""
        rest = np.delete(self.group, clip, axis=0)
        columns = [
            column if column[0] == SHARED else np.unique(column, return_inverse=True)[1]
            for column in rest.T
        ]
        return Grouping(np.stack(columns, axis=1))

    def of(self, parameters: Sequence[int] | np.ndarray) -> "Grouping":
        """The grouping of some of the parameters."""
        return Grouping(self.group[:, np.asarray(parameters, int)])

    def companions(self, clip: int, parameter: int) -> np.ndarray:
        """Indices of the other clips that share a varying parameter's value with a clip."""
        column = self.group[:, parameter]
        alike = np.flatnonzero(column == column[clip])
        return alike[alike != clip]


def _numbered(labels: Sequence[str]) -> np.ndarray:
    """The labels as numbers, in the order in which they first appear."""
    numbers = {label: i for i, label in enumerate(dict.fromkeys(labels))}
    return np.array([numbers[label] for label in labels])
