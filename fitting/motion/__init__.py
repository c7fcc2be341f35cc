"""A clip on its ground: the flat animation below it, its playback, and numbers about motion.

Everything here takes motions, scenes or results and returns numbers, in metres, radians and
fractions. Start with `playback`, which puts the animation, the solved and the captured motion of a
clip side by side; `worst_window` reads it, and `evidence` says which frames determine a parameter.
`flat_animation` makes what a game would play on flat ground. `accuracy` holds the figures of the
blocks benchmark and compares two systems, `measures` says where feet are and how well a motion
stands on its ground. `goodness` compares a fit with its capture, and says whether it fits.
"""
