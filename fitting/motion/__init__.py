"""A clip on its ground: the flat animation below it, its playback, and numbers about motion.

Everything here takes motions, scenes or results and returns numbers, in metres, radians and
fractions. Start with `playback`, which puts the animation, the solved and the captured motion of a
clip side by side; `worst_window` reads it, and `evidence` says which frames determine a parameter.
`flat_animation` makes the animation that a game would play on flat ground. `measures` declares the
measures of a motion on its ground, `accuracy` those against a captured one, and compares two
systems. `goodness` compares a fit with its capture, and says whether it fits.
"""
