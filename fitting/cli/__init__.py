"""The command `jaxik`: its words, what each command calls, and what is shown meanwhile.

Nothing is computed here; the commands call `fitting.jobs`, and `terminal` shows what comes back and
what goes on meanwhile. Each command stands in `fits`, `animations`, `files`, `guides` or `machine`:
its options, its help, and the call that runs it, which imports what it needs so that `--help` is
fast. Start with `options.Command`.
"""
