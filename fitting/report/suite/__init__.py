"""The suite in words, tables and pictures. Start with `suite_report.write`."""
