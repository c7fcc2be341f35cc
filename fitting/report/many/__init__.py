"""The report of many fits: text, tables and a picture of what was found in all of them."""
