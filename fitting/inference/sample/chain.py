"""A chain on disk that survives a kill of the process.

emcee's HDF5 backend (3.1.6, `HDFBackend.save_step`) opens the file at every step, which costs 5 ms,
and changes it in place: 4 of 24 kills between two of its writes left a file that could not be read.
Here a finished step is one record appended to a journal beside the HDF5 file, in one write and with
a checksum. A kill can only tear the last record, which is then dropped.

From time to time `save` writes the whole chain to a new HDF5 file (`write_chain`), replaces the old
one atomically and empties the journal. Steps that are in both are recognised by their number. The
file has the layout of emcee's backend, which can read it, and in its attributes the format and the
identity of the run.
"""

import dataclasses
import errno
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import h5py
import numpy as np
from jaxtyping import Bool, Float

from fitting.runtime.files import check_seal, write_sealed
from fitting.runtime.json_files import check_version
from fitting.runtime.validation import in_one_line

GROUP = "mcmc"  # emcee's name for it
FORMAT = 1
KEYS = 624  # of numpy's Mersenne twister

# numpy's `RandomState.get_state()`: generator, keys, position, whether a normal is left, and which.
RandomState: TypeAlias = tuple[str, np.ndarray, int, int, float]

WINDOW = 5.0  # autocorrelation times to sum over (Sokal 1997, Monte Carlo methods, p. 16)


@dataclasses.dataclass(frozen=True)
class Identity:
    """The settings that a run must share with a chain to continue it."""

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
    """The generator's state from its parts in a file.

    Raises:
        ValueError: no generator has such a state.
        TypeError: an entry is not a number.
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


class LastStep(NamedTuple):
    """The last step of a chain: all that the next one depends on."""

    u: Float[np.ndarray, "walkers free"]
    log_probability: Float[np.ndarray, " walkers"]
    random_state: RandomState


class Chain:
    """The steps so far, in memory and, with a path, on disk."""

    def __init__(self, identity: Identity, path: Path | None = None):
        """Opens the chain at `path`, or starts one there.

        Raises:
            ValueError: if the file is not a chain, or is that of another run.
        """
        self.identity = identity
        self.path = path
        self.accepted = np.zeros(identity.walkers)  # accepted proposals, of one per stored step
        self._u: list[np.ndarray] = []
        self._log_probability: list[np.ndarray] = []
        self._random_state: RandomState | None = None
        self._journal = None
        self._saved = -1  # steps in the HDF5 file
        if path is None:
            return
        if path.exists():
            stored = read_chain(path, identity)
            self.accepted, self._random_state = stored.accepted, stored.random_state
            self._u, self._log_probability = list(stored.u), list(stored.log_probability)
            self._saved = len(self)
            self._read_journal(journal_path(path))
        else:
            journal_path(path).unlink(missing_ok=True)  # of a chain that was deleted
        self.save()
        # Unbuffered, so that each record is one write.
        self._journal = open(journal_path(path), "wb", buffering=0)

    def __len__(self) -> int:
        return len(self._u)

    @property
    def u(self) -> Float[np.ndarray, "steps walkers free"]:
        """Positions of the walkers in `u`."""
        shape = (0, self.identity.walkers, len(self.identity.parameters))
        return np.stack(self._u) if self._u else np.empty(shape)

    @property
    def log_probability(self) -> Float[np.ndarray, "steps walkers"]:
        """Log-density of the posterior there, up to a constant."""
        empty = np.empty((0, self.identity.walkers))
        return np.stack(self._log_probability) if self._u else empty

    @property
    def last(self) -> LastStep | None:
        """The step to continue from; None before the first."""
        if self._random_state is None:
            return None
        return LastStep(self._u[-1].copy(), self._log_probability[-1].copy(), self._random_state)

    def append(
        self,
        u: Float[np.ndarray, "walkers free"],
        log_probability: Float[np.ndarray, " walkers"],
        accepted: Bool[np.ndarray, " walkers"],
        random_state: RandomState,
    ) -> None:
        """Stores one step; once it returns, a kill of this process cannot lose it."""
        if self._journal is not None:
            head = self.identity.token, len(self), u, log_probability, accepted
            record = np.array((*head, *random_state[1:], 0), _record(self.identity))
            record["checksum"] = _checksum(record)
            self._write_record(record.tobytes())
        self._remember(u, log_probability, accepted, random_state)

    def save(self) -> None:
        """Writes the HDF5 file anew and empties the journal; does nothing without a path."""
        if self.path is None or self._saved == len(self):
            return
        chain = StoredChain(self.u, self.log_probability, self.accepted, self._random_state)
        write_chain(self.path, self.identity, chain)
        self._saved = len(self)
        if self._journal is not None:
            self._journal.seek(0)
            self._journal.truncate()

    def __enter__(self) -> "Chain":
        return self

    def __exit__(self, *error: object) -> None:
        """Saves the chain and removes the journal, which stays if the chain cannot be saved."""
        journal, path = self._journal, self.path
        try:
            self.save()
        finally:
            self._journal = None
            if journal is not None:
                journal.close()
        if path is not None:
            journal_path(path).unlink(missing_ok=True)

    def _remember(
        self,
        u: np.ndarray,
        log_probability: np.ndarray,
        accepted: np.ndarray,
        random_state: RandomState,
    ) -> None:
        self._u.append(np.array(u, float))  # copies: emcee moves its walkers in place
        self._log_probability.append(np.array(log_probability, float))
        self.accepted = self.accepted + accepted
        self._random_state = random_state

    def _write_record(self, record: bytes) -> None:
        assert self.path is not None and self._journal is not None
        try:
            if self._journal.write(record) == len(record):
                return
            problem = os.strerror(errno.ENOSPC)  # a part of it was written
        except OSError as error:
            problem = in_one_line(error)
        raise ValueError(f"{journal_path(self.path)}: cannot be written: {problem}")

    def _read_journal(self, path: Path) -> None:
        """Adds the records that continue the chain, up to the first that is torn."""
        if not path.exists():
            return
        for record in np.fromfile(path, _record(self.identity)):
            if record["token"] != self.identity.token or record["checksum"] != _checksum(record):
                break
            if record["step"] < len(self):
                continue  # saved already: killed before the journal was emptied
            if record["step"] > len(self):
                break
            state = random_state(*(record[name] for name in RANDOM_STATE_FIELDS))
            self._remember(record["u"], record["log_probability"], record["accepted"], state)


def journal_path(path: Path) -> Path:
    """The file of the steps since the last `save`."""
    return path.with_name(f"{path.name}.journal")


RANDOM_STATE_FIELDS = ("keys", "position", "has_gauss", "gauss")


def _record(identity: Identity) -> np.dtype:
    """The layout of one step in the journal."""
    walkers = identity.walkers
    return np.dtype(
        [
            ("token", "S32"),
            ("step", "<i8"),
            ("u", "<f8", (walkers, len(identity.parameters))),
            ("log_probability", "<f8", (walkers,)),
            ("accepted", "?", (walkers,)),
            ("keys", "<u4", (624,)),
            ("position", "<i4"),
            ("has_gauss", "<i4"),
            ("gauss", "<f8"),
            ("checksum", "<u4"),
        ]
    )


def _checksum(record: np.ndarray | np.void) -> int:
    """Of everything before the record's last field."""
    return zlib.crc32(record.tobytes()[:-4])


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
