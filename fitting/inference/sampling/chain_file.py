"""The HDF5 file of a chain: what is written, and what is accepted when it is read again.

It has the layout of emcee's backend (3.1.6), which can read it, and in its attributes the format
and the identity of the run.
"""

import dataclasses
import zlib
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import h5py
import numpy as np
from jaxtyping import Float

from fitting.runtime.storage.json_files import check_version
from fitting.runtime.storage.sealed_files import check_seal, write_sealed
from fitting.runtime.validation import in_one_line

GROUP = "mcmc"  # emcee's name for it
FORMAT = 1
KEYS = 624  # of numpy's Mersenne twister

# numpy's `RandomState.get_state()`: generator, keys, position, whether a normal is left, and which.
RandomState: TypeAlias = tuple[str, np.ndarray, int, int, float]


@dataclasses.dataclass(frozen=True)
class Identity:
    """What a run must have in common with a chain to continue it."""

    parameters: tuple[str, ...]
    walkers: int
    seed: int
    thin_by: int
    """Sampler steps per stored step."""
    problem: str
    """Digest of the data and the parameter space."""

    @property
    def token(self) -> bytes:
        """32 characters that identify it in the journal."""
        return f"{zlib.crc32(repr(self).encode()):08x}{self.problem:.24}".encode()


class StoredChain(NamedTuple):
    """All steps of a chain."""

    u: Float[np.ndarray, "steps walkers free"]
    log_probability: Float[np.ndarray, "steps walkers"]
    accepted: Float[np.ndarray, " walkers"]
    """Accepted proposals, of one for each stored step."""
    random_state: RandomState | None
    """After the last step; None before the first."""


def write_chain(path: Path, identity: Identity, chain: StoredChain) -> None:
    """Writes a chain, completely or not at all.

    Raises:
        ValueError: the file cannot be written.
    """

    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        _write(file.create_group(GROUP), identity, chain)
        file.flush()
        image = file.id.get_file_image()
    write_sealed(path, image)


def read_chain(path: Path, current: Identity) -> StoredChain:
    """The chain in a file, which a run with this identity continues.

    Raises:
        ValueError: the file is damaged, has a format that is not known, or is that of another run;
            the message says what to do.
    """
    try:
        check_seal(path)
        with h5py.File(path, "r") as file:
            group: Any = file[GROUP]
            attributes: dict[str, Any] = dict(group.attrs)
            chain, log_probability, accepted = (
                np.array(group[name]) for name in ("chain", "log_prob", "accepted")
            )
        identity = Identity(
            parameters=tuple(str(name) for name in np.atleast_1d(attributes["parameters"])),
            walkers=int(attributes["walkers"]),
            seed=int(attributes["seed"]),
            thin_by=int(attributes["thin_by"]),
            problem=str(attributes["problem"]),
        )
        version = np.asarray(attributes["format"]).item()
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise _refusal(path, in_one_line(error)) from error
    check_version(path, version, FORMAT)
    _check_same_run(path, identity, current)
    try:
        return _checked(identity, chain, log_probability, accepted, attributes)
    except (KeyError, ValueError, TypeError) as error:
        raise _refusal(path, in_one_line(error)) from error


def random_state(keys: Any, position: Any, has_gauss: Any, gauss: Any) -> RandomState:
    """The generator's state from what a file holds of it.

    Raises:
        ValueError: no generator has such a state.
        TypeError: likewise.
    """
    keys = np.array(keys, np.uint32)
    state = "MT19937", keys, int(position), int(has_gauss), float(gauss)
    if keys.shape != (KEYS,) or not 0 <= state[2] <= KEYS:
        raise ValueError(f"a random state of {keys.size} keys, at {state[2]}; wanted {KEYS}")
    return state


def _checked(
    identity: Identity,
    chain: np.ndarray,
    log_probability: np.ndarray,
    accepted: np.ndarray,
    attributes: dict[str, Any],
) -> StoredChain:
    """The chain, if all of its arrays have the shapes and numbers of one."""
    walkers, free = identity.walkers, len(identity.parameters)
    steps = chain.shape[:1]
    arrays = {
        "chain": (chain, (*steps, walkers, free)),
        "log_prob": (log_probability, (*steps, walkers)),
        "accepted": (accepted, (walkers,)),
    }
    for name, (array, shape) in arrays.items():
        if array.dtype.kind not in "fiu" or array.shape != shape:
            raise ValueError(f"{name} is {array.dtype} {array.shape}; wanted numbers {shape}")
        # A walker may start where the log-probability is minus infinity.
        if not (array < np.inf).all() or (name != "log_prob" and not np.isfinite(array).all()):
            raise ValueError(f"{name} has numbers that are not finite")
    if not len(chain):
        return StoredChain(chain, log_probability, accepted, None)
    missing = [i for i in range(1, 5) if f"random_state_{i}" not in attributes]
    if missing:
        raise ValueError(f"it has {len(chain)} steps and no random_state_{missing[0]}")
    state = random_state(*(attributes[f"random_state_{i}"] for i in range(1, 5)))
    return StoredChain(chain.astype(float), log_probability.astype(float), accepted, state)


def _write(group: h5py.Group, identity: Identity, chain: StoredChain) -> None:
    """The layout of emcee 3.1.6, and the identity."""
    group.attrs["format"] = FORMAT
    group.attrs["parameters"] = list(identity.parameters)
    for name in ("walkers", "seed", "thin_by", "problem"):
        group.attrs[name] = getattr(identity, name)
    group.attrs["version"] = "3.1.6"
    group.attrs["nwalkers"] = identity.walkers
    group.attrs["ndim"] = len(identity.parameters)
    group.attrs["has_blobs"] = False
    group.attrs["iteration"] = len(chain.u)
    for i, part in enumerate(chain.random_state or ()):
        group.attrs[f"random_state_{i}"] = part
    group["accepted"] = chain.accepted
    for name, data in (("chain", chain.u), ("log_prob", chain.log_probability)):
        group.create_dataset(name, data=data, maxshape=(None, *data.shape[1:]))


def _refusal(path: Path, problem: str) -> ValueError:
    return ValueError(
        f"{path} is not a chain of this sampler: {problem}; delete the file to sample anew"
    )


def _check_same_run(path: Path, stored: Identity, current: Identity) -> None:
    """Raises ValueError for the first thing in which the two differ."""
    for field in dataclasses.fields(Identity):
        there, here = getattr(stored, field.name), getattr(current, field.name)
        if there != here:
            raise ValueError(
                f"{path} holds the chain of another run: its {field.name} is {there},"
                f" here it is {here}; delete the file or sample into another one"
            )
