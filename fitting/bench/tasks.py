"""All rows of `jaxik bench`, in the order of the table, and the sizes they are measured at."""

from . import crowd as crowds
from . import fits, rows, scaling
from .measure import CEILINGS, Task
from .setup import Sizes

TASKS = {
    CEILINGS: Task("memory, arithmetic and dispatch at their best", "", rows.machine),
    "start": Task("import of jaxik", "", rows.start),
    "legs": Task("two-bone legs, corrections out", "float32", rows.legs),
    "feet": Task("feet: two-bone, ankle, updated transforms", "float32", rows.feet),
    "step": Task("one frame of one character, dispatch included", "float32", rows.step),
    "rays": Task("rays against Embree", "float32", rows.rays),
    "crowd": Task("the record pipeline for a crowd", "float32", crowds.crowd),
    "gradient": Task("its gradient, in reverse", "float32", crowds.gradient),
    "jacobian": Task("residuals of twenty parameters and their slopes", "", fits.jacobian, True),
    "fit": Task(
        "a fit of twenty parameters to a clip of 10 s", "float64", fits.fit, True, long=True
    ),
    "posterior": Task("the posterior of that fit", "float64", fits.posterior, True),
    "scaling": Task("time against sizes", "float32", scaling.scaling, long=True),
}
FULL = Sizes()
QUICK = Sizes(
    repeats=3, characters=64, derived=64, cells=200, rays=200_000, read=1 << 24, crowd_repeats=2,
    fits=1, cold=False, floats=("float64",), steps=20,
    batches=(100, 1000, 10_000), lengths=(100, 1000), grids=(22, 71), parameters=(5, 20),
    legs_each=(2, 4),
)  # fmt: skip
