"""The suite: made situations that every system meets with its defaults, measured against bounds.

`grounds` and `situations` say what is walked on and how; `bounds` says, once, how good is good
enough and why; `suite` runs systems through situations. Start with `suite.run_suite`.
"""
