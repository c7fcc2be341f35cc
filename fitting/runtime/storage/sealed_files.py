"""HDF5 files with a checksum behind their last byte, which HDF5 itself ignores.

HDF5 ends the process with a segmentation fault where some bytes of a file are damaged, or where
the disk is full while it writes. So a file is made in memory, and is checked before HDF5 opens it.
A program that changes the file drops the seal, and then it is not checked.
"""

import zlib
from pathlib import Path

from fitting.runtime.files import write

SEAL = b"jaxik crc32 "
DIGITS = 8


def write_sealed(path: Path, image: bytes | memoryview) -> None:
    """Writes a file and its seal.

    Raises:
        ValueError: it cannot be written.
    """
    seal = SEAL + f"{zlib.crc32(image):0{DIGITS}x}".encode()

    def fill(temporary: Path) -> None:
        with open(temporary, "wb") as stream:
            stream.write(image)
            stream.write(seal)

    write(path, fill)


def check_seal(path: Path) -> None:
    """Checks that a file's bytes are those that were written, if it has a seal.

    Raises:
        ValueError: they are not.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    length = len(SEAL) + DIGITS
    image, seal = memoryview(content)[:-length], content[-length:]
    if seal.startswith(SEAL) and seal[len(SEAL) :] != f"{zlib.crc32(image):0{DIGITS}x}".encode():
        raise ValueError("its bytes are not those that were written")
