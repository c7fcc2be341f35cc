"""Numbers about motion: how a system's motion compares with the captured one or another system's.

Everything here takes motions, scenes or results and returns numbers, in metres, radians and
fractions. Sentences, tables and pictures of them are in `fitting.report`.

Start with `playback`, which puts the animation, the solved and the captured motion of a clip side
by side; `worst_window` reads it. `accuracy` holds the figures of the blocks benchmark, `measures`
says how well a motion stands on its ground, `placement` where its feet are, `misplacement` why
they are not where they should be, `difference` compares two systems, and `limit_activity` says
which limits and decisions a clip exercises. `goodness` tells whether residuals
are the noise that was assumed.
"""
