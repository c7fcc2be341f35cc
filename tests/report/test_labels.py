"""Names, units and formats of the figures in tables."""

import dataclasses
import math

from fitting.analysis.accuracy import Accuracy
from fitting.analysis.difference import QUANTITIES
from fitting.analysis.measures import Measures
from fitting.analysis.playback import RESIDUAL_KINDS
from fitting.report import labels


def test_every_figure_residual_and_difference_has_a_label_in_the_same_order():
    for figures, columns in ((Accuracy, labels.ACCURACY), (Measures, labels.MEASURES)):
        assert list(columns) == [field.name for field in dataclasses.fields(figures)]
    assert list(labels.RESIDUALS) == list(RESIDUAL_KINDS)
    assert list(labels.DIFFERENCES) == list(QUANTITIES)


def test_values_are_shown_in_the_unit_of_their_column():
    assert labels.MEASURES["penetration_mean"].format(0.01234) == "1.23"
    assert labels.MEASURES["reached"].format(0.875) == "87.5"
    assert labels.MEASURES["pops"].format(12.0) == "12"
    assert labels.MEASURES["slide"].format(float("nan")) == "–"


def test_factors_are_those_of_the_units():
    factors = {"%": 100, "cm": 100, "mm": 1000, "°": math.degrees(1), "degrees": math.degrees(1)}
    tables = (labels.ACCURACY, labels.MEASURES, labels.RESIDUALS, labels.DIFFERENCES)
    for column in (column for table in tables for column in table.values()):
        assert column.factor == factors.get(column.unit.split()[0], 1), column
