"""The live viewer of `jaxik view`: a clip in 3-D, solved again while its parameters are dragged.

What is viewed and how it is solved is known without a browser: `subject` is a run or a clip on its
ground, with the numbers that there are to move, `solving` makes a motion of it, says what of it is
wrong in plain sight and what the stages saw, `tuning` is what was moved so far, and how it is
saved. `page` shows all that with viser, an extra; only `views`, the job, imports it.
"""

from .solving import Solved as Solved
from .solving import Solver as Solver
from .subject import Knob as Knob
from .subject import Subject as Subject
from .subject import Take as Take
from .subject import knobs as knobs
from .subject import subject_of_animation as subject_of_animation
from .subject import subject_of_fit as subject_of_fit
from .subject import subject_of_run as subject_of_run
from .tuning import Tuning as Tuning
from .tuning import save as save
