"""The command `jaxik`: words and options, one function per command, progress on stderr.

Nothing is computed here; the commands call `fitting.jobs`, and `terminal` shows what comes back and
what goes on meanwhile. Start with `commands`.
"""
