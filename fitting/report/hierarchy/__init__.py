"""The report of a population: text, tables and a picture of clips that were fitted together."""
