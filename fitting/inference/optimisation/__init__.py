"""The search for the best fit."""
