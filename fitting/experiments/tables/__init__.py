"""Readers of single tables of an experiment file: [[clips]], [prior] and [start]."""
