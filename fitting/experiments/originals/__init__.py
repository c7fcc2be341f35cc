"""Settings of ozz's sample, of Unreal's control rig and of Mec under their own names and units.

`layout` has a table for each of the three, `conversion` turns parameters into settings and back,
and `settings_files` reads and writes them. Start with `layout`. The game's record is no table of
settings but bytes: that is `jaxik.record`.
"""
