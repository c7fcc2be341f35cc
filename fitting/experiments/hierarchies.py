"""The table [hierarchy] of an experiment file: what several clips and subjects have in common.

[hierarchy]
per_subject = ["target.foot_height"]  # one value for each subject that [[clips]] name
per_clip = ["lean.gain"]              # one for each clip; all other free parameters are shared
scale_with_body = true                # numbers are for the body of the first clip, or the adult
                                      # (`body`); those of other bodies are dynamically similar
"""

import dataclasses
from collections.abc import Collection, Sequence

from fitting.inference.hierarchy.grouping import Grouping
from fitting.runtime import validation
from fitting.runtime.validation import Content, check_table

LEVELS = ("per_subject", "per_clip")
NAMES = validation.list_of_texts("a list of names of free parameters")
KEYS = {
    "per_subject": NAMES.meaning("Free parameters of which each subject has its own value."),
    "per_clip": NAMES.meaning("Free parameters of which each clip has its own value."),
    "scale_with_body": validation.BOOLEAN.meaning(
        "Whether lengths, speeds and times follow the legs of each clip's body."
    ),
}


@dataclasses.dataclass(frozen=True)
class Hierarchy:
    """What several clips and subjects have in common."""

    per_subject: tuple[str, ...] = ()
    """Names of free parameters that each subject has its own value of."""
    per_clip: tuple[str, ...] = ()
    """Likewise, each clip."""
    scale_with_body: bool = False
    """Whether lengths, speeds and times follow the legs of each clip's body."""

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of the parameters that are not shared by all clips."""
        return (*self.per_subject, *self.per_clip)

    def level(self, name: str) -> str:
        """What has its own value of a parameter: `clip` or `subject`; else it is `shared`."""
        return (
            "clip" if name in self.per_clip else "subject" if name in self.per_subject else "shared"
        )

    def grouping(
        self, names: Sequence[str], clips: Sequence[str], subjects: Sequence[str]
    ) -> Grouping:
        """Which clips have the values of these parameters in common.

        Args:
            names: of the free parameters.
            clips: a name for each clip, all different.
            subjects: whom each clip shows.
        """
        if not self.varying:
            return Grouping.pooled(len(clips), len(names))
        labels = {"clip": clips, "subject": subjects, "shared": None}
        return Grouping.of_labels([labels[self.level(name)] for name in names])


def read_hierarchy(
    value: object, free: Collection[str], subjects: Sequence[str | None], where: str
) -> Hierarchy:
    """The [hierarchy] of an experiment.

    Args:
        value: as TOML reads it.
        free: names of the free parameters.
        subjects: whom each clip shows; None where it does not say.
        where: the table's place in its file, for error messages.

    Raises:
        ValueError: a key is unknown, or a value is wrong; a name is not free or stands twice; a
            parameter is to vary between subjects, and a clip does not say whom it shows, or all
            show the same; a parameter is to vary between clips, and there is only one.
    """
    table = check_table(value, KEYS, where)
    lists = {level: tuple(table.get(level, ())) for level in LEVELS}
    names = [name for level in LEVELS for name in lists[level]]
    for name in names:
        if name not in free:
            raise ValueError(f"{where}: {name!r} is not free; free are {sorted(free)}")
        if names.count(name) > 1:
            raise ValueError(f"{where}: {name!r} stands twice; wanted it per clip or per subject")
    if lists["per_clip"] and len(subjects) < 2:
        raise ValueError(f"{where}: per_clip needs two clips or more; there is one")
    if lists["per_subject"]:
        if None in subjects:
            number = subjects.index(None) + 1
            raise ValueError(
                f"{where}: per_subject needs a subject in each of [[clips]]; clip {number} has none"
            )
        if len(set(subjects)) < 2:
            raise ValueError(
                f"{where}: per_subject needs two subjects or more; all clips are of {subjects[0]!r}"
            )
    return Hierarchy(**lists, scale_with_body=table.get("scale_with_body", False))


def hierarchy_to_table(hierarchy: Hierarchy) -> Content:
    """The [hierarchy] table; empty for the default."""
    return {name: value for name, value in dataclasses.asdict(hierarchy).items() if value}
