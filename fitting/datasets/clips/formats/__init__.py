"""Readers and writers of motion files, one module a format."""
