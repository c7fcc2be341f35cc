"""The live viewer of `jaxik view`: a clip in 3-D, solved again while its parameters are dragged.

What is viewed and how it is solved is known without a browser: `subject` is a run or a clip on its
ground, `solving` makes a motion of it, `feet` says what of it is wrong in plain sight, `overlays`
what the stages saw, `knobs` which numbers there are to move, `tuning` what was moved so far, and
`saving` writes it. `page` shows all that with viser, an extra; nothing else imports that.
"""

from .knobs import Knob as Knob
from .knobs import knobs as knobs
from .saving import save as save
from .solving import Solved as Solved
from .solving import Solver as Solver
from .subject import Subject as Subject
from .subject import Take as Take
from .subject import subject_of_animation as subject_of_animation
from .subject import subject_of_fit as subject_of_fit
from .subject import subject_of_run as subject_of_run
from .tuning import Tuning as Tuning
