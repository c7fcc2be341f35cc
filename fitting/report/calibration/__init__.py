"""The report of a calibration: text, tables and pictures of what was found in all replicates."""
