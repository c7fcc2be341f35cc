"""A first experiment for clips of one's own: what is assumed of them, and what to fit.

`draft.py` loads the clips and chooses the free parameters; `assumptions.py` says what is taken for
granted and how well the clips bear it out. Start with `draft`.
"""
