"""Exit statuses of the commands."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fitting.studies.fit.fit import Fit
    from fitting.studies.many.fit_many import ManyFits

PROBLEMS_FOUND = 1  # by `doctor`
NOT_CONVERGED = 3  # the search of a fit
DOES_NOT_FIT = 4  # a fit that has converged
OUTSIDE = 5  # of its bounds, a calibration
FAILED = 6  # at least one of many fits
WORSE = 7  # a fit, than the animation without foot IK or the system before it


def of_job(*, interrupted: bool) -> int:
    """The exit status of a job whose results are written; an interrupt goes on to `main`."""
    if interrupted:
        raise KeyboardInterrupt
    return 0


def of_fit(fitted: "Fit") -> int:
    """The exit status of a search; what a translation leaves over is a result, and no failure."""
    of_job(interrupted=fitted.solution.interrupted)
    if fitted.is_worse:
        return WORSE
    if not fitted.solution.converged:
        return NOT_CONVERGED
    return DOES_NOT_FIT if fitted.has_noise and not fitted.verdict.fits else 0


def of_many(fits: "ManyFits") -> int:
    """The exit status of many fits; whether each fits is a result, and no failure."""
    of_job(interrupted=fits.interrupted)
    if fits.failed:
        return FAILED
    return NOT_CONVERGED if fits.unconverged else 0
