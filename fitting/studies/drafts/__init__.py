"""A first experiment for clips of one's own: what is assumed of them, and what to fit.

`draft` loads the clips, chooses the free parameters, and says what is taken for granted and how
well the clips bear it out; `draft_report` writes the file.
"""
