"""Many fits: what is to be fitted, each fit's row, and the table of all rows."""
