"""Fits of several clips and subjects: each alone, pooled, and as a population of a mixed model."""
