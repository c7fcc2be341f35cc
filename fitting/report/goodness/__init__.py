"""Goodness of fit in words and tables. Start with `goodness_report.section`."""
