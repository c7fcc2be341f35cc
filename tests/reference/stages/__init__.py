"""Stages of the references: what several systems share."""
