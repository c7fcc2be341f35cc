"""What motion shows of a capture that is not as it seems: its ground, and when it begins.

Each sign is named only where it is clear: large enough to matter, and much larger than its scatter.
"""
