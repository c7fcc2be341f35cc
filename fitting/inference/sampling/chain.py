"""A chain on disk that a kill cannot spoil.

emcee's HDF5 backend (3.1.6, `HDFBackend.save_step`) opens the file at every step, which costs 5 ms,
and changes it in place: of 24 kills between two of its writes to the disk 4 left a file from which
nothing could be read. Here a finished step is one record appended to a journal beside the HDF5
file, in one write and with a checksum, so that a kill can only tear the last one, which is then
dropped.
From time to time `save` writes the whole chain to a new HDF5 file, exchanges it for the old one
(an exchange that either happens or does not) and empties the journal. Steps that stand in both are
recognised by their number. The HDF5 file has the layout of emcee's backend, which can read it.
"""

import dataclasses
import os
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from jaxtyping import Bool, Float

GROUP = "mcmc"  # emcee's name for it
FORMAT = 1


@dataclasses.dataclass(frozen=True)
class Identity:
    """What a chain must share with a run that continues it."""

    parameters: tuple[str, ...]
    walkers: int
    seed: int
    thin_by: int  # sampler steps per stored step
    problem: str  # digest of the data and the space

    @property
    def token(self) -> bytes:
        """32 characters that stand for it in the journal."""
        return f"{zlib.crc32(repr(self).encode()):08x}{self.problem:.24}".encode()


class LastStep(NamedTuple):
    """All that the next step depends on."""

    u: Float[np.ndarray, "walkers free"]
    log_probability: Float[np.ndarray, " walkers"]
    random_state: tuple[Any, ...]  # of numpy's RandomState


class Chain:
    """The steps so far, in memory, and on disk if it has a path."""

    def __init__(self, identity: Identity, path: Path | None = None):
        """Opens the chain at `path`, or starts one there.

        Raises:
            ValueError: where the file is not a chain, or is one of another run.
        """
        self.identity = identity
        self.path = path
        self.accepted = np.zeros(identity.walkers)  # accepted proposals, of one per stored step
        self._u: list[np.ndarray] = []
        self._log_probability: list[np.ndarray] = []
        self._random_state: tuple[Any, ...] | None = None
        self._journal = None
        self._saved = -1  # steps in the HDF5 file
        if path is None:
            return
        if path.exists():
            self._read_file(path)
            self._saved = len(self)
            self._read_journal(journal_path(path))
        else:
            journal_path(path).unlink(missing_ok=True)  # of a chain that someone deleted
        self.save()
        # Unbuffered: a record is one write, and waits in no buffer of this process.
        self._journal = open(journal_path(path), "wb", buffering=0)

    def __len__(self) -> int:
        return len(self._u)

    @property
    def u(self) -> Float[np.ndarray, "steps walkers free"]:
        """Where the walkers were, without bounds."""
        shape = (0, self.identity.walkers, len(self.identity.parameters))
        return np.stack(self._u) if self._u else np.empty(shape)

    @property
    def log_probability(self) -> Float[np.ndarray, "steps walkers"]:
        """Of the posterior, up to a constant."""
        empty = np.empty((0, self.identity.walkers))
        return np.stack(self._log_probability) if self._u else empty

    @property
    def last(self) -> LastStep | None:
        """Where to go on; None before the first step."""
        if self._random_state is None:
            return None
        return LastStep(self._u[-1].copy(), self._log_probability[-1].copy(), self._random_state)

    def append(
        self,
        u: Float[np.ndarray, "walkers free"],
        log_probability: Float[np.ndarray, " walkers"],
        accepted: Bool[np.ndarray, " walkers"],
        random_state: tuple[Any, ...],
    ) -> None:
        """Keeps one step; when it returns, no kill of this process loses it."""
        if self._journal is not None:
            record = np.zeros((), _record(self.identity))
            record["token"] = self.identity.token
            record["step"] = len(self)
            record["u"] = u
            record["log_probability"] = log_probability
            record["accepted"] = accepted
            _, record["keys"], record["position"], record["has_gauss"], record["gauss"] = (
                random_state
            )
            record["checksum"] = _checksum(record)
            self._journal.write(record.tobytes())
        self._take(u, log_probability, accepted, random_state)

    def save(self) -> None:
        """Writes the HDF5 file anew and empties the journal; nothing without a path."""
        if self.path is None or self._saved == len(self):
            return
        fresh = self.path.with_name(f"{self.path.name}.new")
        with h5py.File(fresh, "w") as file:
            self._write(file.create_group(GROUP))
        with open(fresh, "rb") as raw:
            os.fsync(raw.fileno())  # on the disk before its name is: the power may fail too
        os.replace(fresh, self.path)
        self._saved = len(self)
        if self._journal is not None:
            self._journal.seek(0)
            self._journal.truncate()

    def __enter__(self) -> "Chain":
        return self

    def __exit__(self, *error: object) -> None:
        """Saves and leaves only the HDF5 file."""
        self.save()
        if self.path is not None and self._journal is not None:
            self._journal.close()
            self._journal = None
            journal_path(self.path).unlink(missing_ok=True)

    def _take(
        self, u: np.ndarray, log_probability: np.ndarray, accepted: np.ndarray, state: tuple
    ) -> None:
        self._u.append(np.array(u, float))  # copies: emcee moves its walkers in place
        self._log_probability.append(np.array(log_probability, float))
        self.accepted = self.accepted + accepted
        self._random_state = tuple(state)

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
            found = Identity(
                parameters=tuple(attributes["parameters"].tolist()),
                walkers=int(attributes["walkers"]),
                seed=int(attributes["seed"]),
                thin_by=int(attributes["thin_by"]),
                problem=str(attributes["problem"]),
            )
        except (OSError, KeyError, ValueError) as error:
            raise ValueError(f"{path} is not a chain of this sampler: {error}") from error
        _compare(path, found, self.identity)
        self.accepted = accepted
        self._u = list(chain)
        self._log_probability = list(log_probability)
        if len(self):
            self._random_state = tuple(attributes[f"random_state_{i}"] for i in range(5))

    def _read_journal(self, path: Path) -> None:
        """Takes the records that continue the chain, up to the first that is torn."""
        if not path.exists():
            return
        for record in np.fromfile(path, _record(self.identity)):
            if record["token"] != self.identity.token or record["checksum"] != _checksum(record):
                break
            if record["step"] < len(self):
                continue  # saved already; the kill came before the journal was emptied
            if record["step"] > len(self):
                break
            names = ("keys", "position", "has_gauss", "gauss")
            keys, position, has_gauss, gauss = (record[name] for name in names)
            state = ("MT19937", keys.copy(), int(position), int(has_gauss), float(gauss))
            self._take(record["u"], record["log_probability"], record["accepted"], state)


def journal_path(path: Path) -> Path:
    """Where the steps since the last `save` stand."""
    return path.with_name(f"{path.name}.journal")


def _record(identity: Identity) -> np.dtype:
    """One step in the journal."""
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


def _checksum(record: Any) -> int:
    """Of everything before the record's last field."""
    return zlib.crc32(record.tobytes()[:-4])


def _compare(path: Path, found: Identity, wanted: Identity) -> None:
    """Raises ValueError for the first thing in which the two differ."""
    for field in dataclasses.fields(Identity):
        there, here = getattr(found, field.name), getattr(wanted, field.name)
        if there != here:
            raise ValueError(
                f"{path} holds the chain of another run: its {field.name} is {there},"
                f" here it is {here}; delete the file or sample into another one"
            )
