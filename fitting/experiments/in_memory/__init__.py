"""Experiments of objects in memory, with no file on disk.

`making` builds one of clips, terrains and a system, `selectors` names free parameters by the leaf
that a function picks, and `saving` writes the objects where a run folder needs them as files.
"""
