"""The islands of a posterior: a sentence for the terminal, and their section of summary.md."""

import math
from collections.abc import Mapping

import numpy as np

from fitting.inference.sampling.islands import MIN_EXCHANGES, Island
from fitting.inference.sampling.posterior import Posterior
from fitting.problem.space import Space
from fitting.report.formatting import Table, markdown, number, percent


def island_sentences(posterior: Posterior) -> list[str]:
    """How many islands there are, what they weigh, and which walkers were left out and why."""
    sentences = []
    if posterior.islands:
        weights = ", ".join(_weight(island) for island in posterior.islands)
        sentences.append(f"The posterior has {len(posterior.islands)} islands: {weights}.")
    if posterior.isolated:
        walkers = ", ".join(map(str, posterior.isolated))
        sentences.append(
            f"Left out are walkers {walkers}, which never came near the others' log-probability; "
            f"by its height and width, about {percent(posterior.isolated_mass, 2)} of the "
            "posterior lies there."
        )
    return sentences


def island_section(posterior: Posterior, space: Space, units: Mapping[str, str]) -> list[str]:
    """Paragraphs of Markdown; none where there is one island only."""
    islands = posterior.islands
    if not islands:
        return []
    parts = [
        "### Islands",
        "Parts of the posterior that lie apart. Walkers come and go between them by jumps, so that "
        "each weighs as many draws as it deserves; exchanges count how often one came or left.",
        markdown(island_table(islands)),
        "Medians on each island:",
        markdown(median_table(islands, space, units)),
    ]
    if not all(island.is_weighed for island in islands):
        parts.append(
            f"Where there were fewer than {MIN_EXCHANGES} exchanges, the weight is out of reach: "
            "there are as many draws as walkers happened to start there, and intervals over all "
            "islands are no better. Sample longer, or narrow a prior to the island that is meant."
        )
    return parts


def island_table(islands: tuple[Island, ...]) -> Table:
    """Weight, exchanges and height of each island."""
    table = [["island", "weight", "exchanges", "walkers at the end", "highest log-probability"]]
    for index, island in enumerate(islands, 1):
        table.append(
            [
                str(index),
                _weight(island),
                str(island.exchanges),
                str(island.walkers),
                number(island.log_probability),
            ]
        )
    return table


def median_table(islands: tuple[Island, ...], space: Space, units: Mapping[str, str]) -> Table:
    """Median of each parameter on each island."""
    values = np.asarray(space.values(np.stack([island.median for island in islands])))
    heading = [f"island {index}" for index in range(1, len(islands) + 1)]
    rows = zip(space.names, values.T, strict=True)
    return [
        ["parameter", "unit", *heading],
        *([name, units[name], *map(number, row)] for name, row in rows),
    ]


def _weight(island: Island) -> str:
    if math.isnan(island.error):
        return f"out of reach ({percent(island.weight)} of the draws)"
    return f"{percent(island.weight)} ± {percent(island.error)}"
