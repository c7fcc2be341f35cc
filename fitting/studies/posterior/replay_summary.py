"""What the motion of a posterior's draws says, as `posterior.json` holds it."""

import math

from fitting.inference.sampling.blocks import LeaveOneOut
from fitting.runtime.validation import Content

from .predictive import Band, PredictiveCheck, Statistic
from .replay import Replay

STATISTICS = ("rms", "autocorrelation", "largest")


def summarise_replay(replay: Replay | None, left_out: LeaveOneOut | None) -> Content:
    """Predictive checks and leave-one-out; None where there are none."""
    if replay is None:
        return {"predictive_checks": None, "leave_one_out": None}
    pairs = zip(replay.checks, replay.bands, strict=True)
    return {
        "predictive_checks": [_check(check, band) for check, band in pairs],
        "leave_one_out": None if left_out is None else _left_out(left_out, replay),
    }


def _check(check: PredictiveCheck, band: Band) -> Content:
    statistics = {name: _statistic(getattr(check, name)) for name in STATISTICS}
    return {
        "clip": check.clip + 1,
        "kind": check.kind,
        **statistics,
        "outside_band": band.outside,
        "surprises": check.surprises,
    }


def _statistic(statistic: Statistic) -> Content:
    """Medians over the draws, and the posterior predictive p-value."""
    return {
        "captured": statistic.median,
        "replicated": list(statistic.replicated_interval),
        "p": statistic.p,
    }


def _left_out(found: LeaveOneOut, replay: Replay) -> Content:
    blocks = replay.blocks
    columns = (blocks.clip, blocks.start, blocks.end, found.elpd_of_block)
    names = ("clip", "start", "end", "elpd", "pareto_k")
    shapes = map(_finite, found.pareto_k.tolist())
    rows = zip(*(column.tolist() for column in columns), shapes, strict=True)
    return {
        "elpd": found.elpd,
        "error": found.error,
        "parameters": found.parameters,
        "max_k": found.max_k,
        "neighbours": _finite(found.neighbours),
        "data": blocks.data,
        "blocks": [dict(zip(names, row, strict=True)) for row in rows],
    }


def _finite(value: float) -> float | None:
    """None for what JSON does not have."""
    return value if math.isfinite(value) else None
