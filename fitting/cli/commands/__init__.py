"""One function per command: reads the options, calls the job, prints."""

import argparse
from collections.abc import Callable

from . import animations, files, fits, guides, machine, many

COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "init": fits.init,
    "fit": fits.fit,
    "ablate": fits.ablate,
    "calibrate": fits.calibrate,
    "population": fits.population,
    "fit-many": many.fit_many,
    "sample": fits.sample,
    "apply": animations.apply,
    "run": animations.run,
    "view": animations.view,
    "compare": animations.compare,
    "translate": fits.translate,
    "inspect": files.inspect,
    "terrain": files.terrain,
    "bench": machine.bench,
    "record": files.convert_record,
    "export": files.export,
    "cache": machine.cache,
    "parameters": guides.parameters,
    "schema": guides.schema,
    "example": guides.example,
}
