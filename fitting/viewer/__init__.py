"""The live viewer of `jaxik view`: a clip in 3-D, solved again while its parameters are dragged.

`session` holds a run, or a clip on its ground; `solving` solves a clip; `edits` takes and saves
what is changed by hand; `server` serves the page, which is that of reports; `views` has the jobs.
"""

from fitting.report.sliders import Slider as Slider
from fitting.report.sliders import sliders as sliders

from .edits import Tuning as Tuning
from .edits import save as save
from .session import Session as Session
from .session import SessionClip as SessionClip
from .session import session_of_animation as session_of_animation
from .session import session_of_fit as session_of_fit
from .session import session_of_run as session_of_run
from .solving import Solved as Solved
from .solving import Solver as Solver
