"""What a fit of the game's record alone costs: text for the terminal, and for summary.md."""

from fitting.experiments.experiment import Experiment
from fitting.experiments.record_only import left_out, set_aside
from fitting.report.formatting import Table, aligned, joined, markdown, number
from fitting.report.labels import RESIDUALS
from fitting.studies.record_price import RecordPrice


def text(experiment: Experiment, price: RecordPrice | None) -> str:
    """The price, for the terminal."""
    if price is None:
        return _sentence(experiment, price)
    return joined([_sentence(experiment, price), aligned(_table(price))], apart=True)


def section(experiment: Experiment, price: RecordPrice | None) -> list[str]:
    """Paragraphs of Markdown."""
    parts = ["## What the record costs", _sentence(experiment, price)]
    return parts if price is None else [*parts, markdown(_table(price))]


def _sentence(experiment: Experiment, price: RecordPrice | None) -> str:
    head = "Only what the 128 bytes of the game's record hold was fitted, "
    names = left_out(experiment)
    head += f"not {', '.join(names)}" if names else "which is all that the experiment has free"
    head += ": `record to-bytes` loses nothing."
    if aside := set_aside(experiment):
        listed = ", ".join(f"{name} is {now}, not {was}" for name, (was, now) in aside.items())
        head += f" Where the experiment fixes what they do not hold, their reader's: {listed}."
    if not names:
        return head
    if price is None:
        return f"{head} What that costs was not measured, as a search was interrupted."
    return (
        f"{head} The cost is {price.cost:.6g}; with these free, too, a search from there ends "
        f"at {price.whole_cost:.6g}."
    )


def _table(price: RecordPrice) -> Table:
    table = [["error, rms", "record only", "all free"]]
    for kind, sizes in price.errors.items():
        name, unit, factor = RESIDUALS[kind]
        table.append([name, *(f"{number(factor * size)} {unit}" for size in sizes)])
    return table
