"""A first experiment as text: its commented file, and what it assumes.

Start with `draft_report`.
"""
