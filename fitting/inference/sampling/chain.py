"""A chain on disk that survives a kill of the process.

emcee's HDF5 backend (3.1.6, `HDFBackend.save_step`) opens the file at every step, which costs 5 ms,
and changes it in place: 4 of 24 kills between two of its writes left a file that could not be read.
Here a finished step is one record appended to a journal beside the HDF5 file, in one write and with
a checksum. A kill can only tear the last record, which is then dropped.

From time to time `save` writes the whole chain to a new HDF5 file (`chain_file`), replaces the old
one atomically and empties the journal. Steps that are in both are recognised by their number.
"""

import errno
import os
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fitting.runtime.validation import in_one_line

from .chain_file import (
    Identity,
    RandomState,
    StoredChain,
    random_state,
    read_chain,
    write_chain,
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

    def _read_file(self, path: Path) -> None:
        stored = read_chain(path, self.identity)
        self.accepted = stored.accepted
        self._u = list(stored.u)
        self._log_probability = list(stored.log_probability)
        self._random_state = stored.random_state

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
