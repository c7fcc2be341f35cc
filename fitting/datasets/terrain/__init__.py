"""Terrain from mesh files and from the stances of a captured clip."""
