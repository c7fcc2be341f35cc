"""Clips and terrain, read from files or synthesised."""
