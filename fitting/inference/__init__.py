"""The best fit, its posterior, and what the data determine."""
