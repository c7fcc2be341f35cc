"""A chain on disk that survives a kill of the process.

emcee's HDF5 backend (3.1.6, `HDFBackend.save_step`) opens the file at every step, which costs 5 ms,
and changes it in place: 4 of 24 kills between two of its writes left a file that could not be read.
Here a finished step is one record appended to a journal beside the HDF5 file, in one write and with
a checksum. A kill can only tear the last record, which is then dropped.

From time to time `save` writes the whole chain to a new HDF5 file, replaces the old one atomically
and empties the journal. Steps that are in both are recognised by their number. The HDF5 file has
the layout of emcee's backend, which can read it.
"""

import dataclasses
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import h5py
import numpy as np
from jaxtyping import Bool, Float

GROUP = "mcmc"  # emcee's name for it
FORMAT = 1

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
            self._read_file(path)
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
            record = np.zeros((), _record(self.identity))
            record["token"] = self.identity.token
            record["step"] = len(self)
            record["u"] = u
            record["log_probability"] = log_probability
            record["accepted"] = accepted
            for name, part in zip(RANDOM_STATE_FIELDS, random_state[1:], strict=True):
                record[name] = part
            record["checksum"] = _checksum(record)
            self._journal.write(record.tobytes())
        self._remember(u, log_probability, accepted, random_state)

    def save(self) -> None:
        """Writes the HDF5 file anew and empties the journal; does nothing without a path."""
        if self.path is None or self._saved == len(self):
            return
        temporary = self.path.with_name(f"{self.path.name}.new")
        with h5py.File(temporary, "w") as file:
            self._write(file.create_group(GROUP))
        with open(temporary, "rb") as raw:
            os.fsync(raw.fileno())  # the content before the name, in case the power fails
        os.replace(temporary, self.path)
        self._saved = len(self)
        if self._journal is not None:
            self._journal.seek(0)
            self._journal.truncate()

    def __enter__(self) -> "Chain":
        return self

    def __exit__(self, *error: object) -> None:
        """Saves the chain and removes the journal."""
        self.save()
        if self.path is not None and self._journal is not None:
            self._journal.close()
            self._journal = None
            journal_path(self.path).unlink(missing_ok=True)

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

    def _write(self, group: h5py.Group) -> None:
        """The layout of emcee 3.1.6, and the identity."""
        identity = self.identity
        group.attrs["format"] = FORMAT
        group.attrs["parameters"] = list(identity.parameters)
        for name in ("walkers", "seed", "thin_by", "problem"):
            group.attrs[name] = getattr(identity, name)
        group.attrs["version"] = "3.1.6"
        group.attrs["nwalkers"] = identity.walkers
        group.attrs["ndim"] = len(identity.parameters)
        group.attrs["has_blobs"] = False
        group.attrs["iteration"] = len(self)
        for i, part in enumerate(self._random_state or ()):
            group.attrs[f"random_state_{i}"] = part
        group["accepted"] = self.accepted
        for name, data in (("chain", self.u), ("log_prob", self.log_probability)):
            group.create_dataset(name, data=data, maxshape=(None, *data.shape[1:]))

    def _read_file(self, path: Path) -> None:
        try:
            with h5py.File(path, "r") as file:
                group: Any = file[GROUP]
                attributes: dict[str, Any] = dict(group.attrs)
                chain, log_probability, accepted = (
                    np.asarray(group[name]) for name in ("chain", "log_prob", "accepted")
                )
            if attributes["format"] != FORMAT:
                raise ValueError(f"its format is {attributes['format']}, wanted {FORMAT}")
            identity = Identity(
                parameters=tuple(attributes["parameters"].tolist()),
                walkers=int(attributes["walkers"]),
                seed=int(attributes["seed"]),
                thin_by=int(attributes["thin_by"]),
                problem=str(attributes["problem"]),
            )
        except (OSError, KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a chain of this sampler: {error}") from error
        _check_same_run(path, identity, self.identity)
        self.accepted = accepted
        self._u = list(chain)
        self._log_probability = list(log_probability)
        if len(self):
            self._random_state = _random_state(
                *(attributes[f"random_state_{i}"] for i in range(1, 5))
            )

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
            state = _random_state(*(record[name] for name in RANDOM_STATE_FIELDS))
            self._remember(record["u"], record["log_probability"], record["accepted"], state)


def journal_path(path: Path) -> Path:
    """The file of the steps since the last `save`."""
    return path.with_name(f"{path.name}.journal")


RANDOM_STATE_FIELDS = ("keys", "position", "has_gauss", "gauss")


def _random_state(
    keys: np.ndarray, position: np.integer, has_gauss: np.integer, gauss: np.floating
) -> RandomState:
    """The generator's state from what a file holds of it."""
    return "MT19937", keys.copy(), int(position), int(has_gauss), float(gauss)


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


def _check_same_run(path: Path, stored: Identity, current: Identity) -> None:
    """Raises ValueError for the first thing in which the two differ."""
    for field in dataclasses.fields(Identity):
        there, here = getattr(stored, field.name), getattr(current, field.name)
        if there != here:
            raise ValueError(
                f"{path} holds the chain of another run: its {field.name} is {there},"
                f" here it is {here}; delete the file or sample into another one"
            )
