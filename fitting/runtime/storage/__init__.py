"""Folders and files that outlive the process that wrote them, and what may have become of them.

`json_files` reads and writes JSON with a format version and a declared content, which
`declared_types` checks. `sealed_files` keeps damaged bytes from HDF5. `claimed_folder` keeps a
second process out of a folder. `compiled_programs` keeps JAX from leaving half a file.
"""
