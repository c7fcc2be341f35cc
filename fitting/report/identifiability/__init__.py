"""The section of a fit's summary on what its clips determine, and what they do not."""
