"""Fits of several clips and subjects: each alone, pooled, and as a population of a mixed model.

`population` computes them, `population_report` says and shows what they found.
"""
