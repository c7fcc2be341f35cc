"""How long a chain remembers. Plain NumPy."""

import numpy as np
from jaxtyping import Float

WINDOW = 5.0  # autocorrelation times to sum over (Sokal 1997, Monte Carlo methods, p. 16)


def autocorrelation_time(
    chain: Float[np.ndarray, "steps walkers free"],
) -> Float[np.ndarray, " free"]:
    """Integrated autocorrelation time of every parameter, in steps, at least 1.

    Sokal's window on the walkers' summed autocovariance about their common mean. emcee takes each
    walker about its own mean: a walker that never moves then adds nothing, and the time looks
    healthy. About the common mean its offset never decays, and the time grows with the chain.
    Infinite for a parameter that never changes.
    """
    steps, _, free = chain.shape
    length = 1 << (2 * steps - 1).bit_length()  # padded, so that the end does not meet the start
    times = np.empty(free)
    for i in range(free):
        centred = chain[..., i] - chain[..., i].mean()
        power = (np.abs(np.fft.rfft(centred, length, axis=0)) ** 2).sum(axis=1)
        covariance = np.fft.irfft(power, length)[:steps]
        if not covariance[0] > 0:
            times[i] = np.inf
            continue
        sums = 2 * np.cumsum(covariance / covariance[0]) - 1
        inside = np.arange(steps) < WINDOW * sums
        window = np.argmin(inside) if not inside.all() else steps - 1
        times[i] = max(1.0, sums[window])
    return times
