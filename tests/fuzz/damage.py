"""Damage to files: to bytes, to the lines and words of text, and to the arrays of archives.

Every function draws from a generator with a seed, so that each damaged file can be made again.
"""

import io
import json
import re
import tomllib
from collections.abc import Mapping
from typing import Any

import numpy as np
import tomli_w

Random = np.random.Generator
Arrays = Mapping[str, np.ndarray]

NUMBERS = (
    "0", "-1", "1", "-0.0", "0.5", "1e-300", "5e-324", "1e300", "-1e308", "1e999", "nan", "inf",
    "-inf", "255", "65536", "4294967295", "10000000000", "99999999999999999999", "0x10", "1e",
)  # fmt: skip
NUMBER = re.compile(rb"-?[0-9.]+(e-?[0-9]+)?")
WORDS = (
    "", "true", "\0", "é", "\ufeff", "\u2028", "x" * 300, "../../x", "/dev/null", "[]", "{}", "''",
    "[[1, 2], [3]]", "2020-01-01", "{", "}", "end", "#",
)  # fmt: skip
ODD_VALUES = (
    0, -1, 1, 3, 10**10, 10**400, 2**63 - 1, 0.0, 0.3, -0.5, 1e-300, 1e300, float("nan"),
    float("inf"), -float("inf"), True, False, "", "x", "\0", "lean.half_life", [], {}, [[]],
    [1.0, 2.0], [1, "x"], [[0.5, 0.4]], {"x": 1}, {"low": 0.1}, [{}], "x" * 10_000,
)  # fmt: skip
BLOCKS = (b"\0", b"\xff", b"\0" * 16, b"\xff" * 8, b"\xff\xfe", b"\r\n", b"\n\n", b"\x1b[2J")
VALUES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e-320, 1e20, 1e308, 2**62)
DTYPES = ("f4", "i8", "u1", "?", "U4", "S3", "c16", "M8[s]")
MOST_CHANGES = 4  # to a file


def choose(random: Random, choices):
    """One of a sequence, as it stands there: NumPy would convert it."""
    return choices[random.integers(len(choices))]


def change_count(random: Random) -> int:
    """How many changes a file gets: most often one."""
    return min(int(random.geometric(0.6)), MOST_CHANGES)


def damage_bytes(random: Random, content: bytes) -> bytes:
    """The content with a few bytes overwritten, removed, repeated or put in."""
    changed = bytearray(content)
    for _ in range(change_count(random)):
        first, last = sorted(int(i) for i in random.integers(len(changed) + 1, size=2))
        last = min(last, first + 64)
        match random.integers(6):
            case 0 if changed:
                changed[min(first, len(changed) - 1)] = random.integers(256)
            case 1:
                number = int(choose(random, (0, 1, 2**31 - 1, 2**32 - 1, 10**9)))
                changed[first : first + 4] = number.to_bytes(4, choose(random, ("little", "big")))
            case 2:
                del changed[first:]
            case 3:
                del changed[first:last]
            case 4:
                changed[first:first] = changed[first:last]
            case _:
                changed[first:first] = choose(random, BLOCKS)
    return bytes(changed)


def damage_lines(random: Random, content: bytes) -> bytes:
    """The content with a few lines removed, repeated, swapped or cut."""
    lines = content.splitlines(keepends=True)
    for _ in range(change_count(random)):
        if not lines:
            break
        here, there = (int(i) for i in random.integers(len(lines), size=2))
        match random.integers(5):
            case 0:
                del lines[here]
            case 1:
                lines[here:here] = lines[there : there + 3]
            case 2:
                lines[here], lines[there] = lines[there], lines[here]
            case 3:
                lines[here] = lines[here][: random.integers(len(lines[here]) + 1)]
            case _:
                lines[here:here] = [lines[there]] * int(choose(random, (2, 20, 200)))
    return b"".join(lines)


def damage_words(random: Random, content: bytes) -> bytes:
    """The content with a few of its words and numbers replaced, by odd ones or by each other."""
    words = re.split(rb"([\s,=\"]+)", content)
    numbers = [i for i in range(0, len(words), 2) if NUMBER.fullmatch(words[i])]
    for _ in range(change_count(random)):
        here, there = (2 * int(i) for i in random.integers((len(words) + 1) // 2, size=2))
        if numbers and random.random() < 0.5:
            here, there = choose(random, numbers), choose(random, numbers)
        match random.integers(4):
            case 0:
                words[here] = choose(random, NUMBERS).encode()
            case 1:
                words[here] = choose(random, WORDS).encode()
            case 2:
                words[here] = words[there]
            case _:
                words[here] += choose(random, (b" ", b"0", b".", b"\0", b"\xff", b"-", b"\n"))
    return b"".join(words)


TEXT_DAMAGES = (damage_bytes, damage_lines, damage_words, damage_words)


def damage_text(random: Random, content: bytes) -> bytes:
    """The content with one kind of damage, most often to its words."""
    return choose(random, TEXT_DAMAGES)(random, content)


def damage_value(random: Random, content: Any) -> Any:
    """A tree of tables and lists with one entry changed, removed, put in or given another key."""
    if not isinstance(content, dict | list) or not content or random.random() < 0.1:
        return choose(random, ODD_VALUES)
    changed = content.copy()
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key, other = choose(random, keys), choose(random, keys)
    match random.integers(8):
        case 0:
            del changed[key]
        case 1:
            changed[key] = content[other]
        case 2 if isinstance(changed, dict):
            changed[str(choose(random, WORDS))] = changed.pop(key)
        case 3 if isinstance(changed, dict):
            changed[str(choose(random, WORDS))] = choose(random, ODD_VALUES)
        case _:
            changed[key] = damage_value(random, content[key])
    return changed


def damage_toml(random: Random, content: bytes) -> bytes:
    """A TOML file with other values or keys, or with damaged text."""
    if random.random() < 0.4:
        return damage_text(random, content)
    changed = damage_value(random, tomllib.loads(content.decode()))
    return tomli_w.dumps(changed if isinstance(changed, dict) else {"x": changed}).encode()


def damage_json(random: Random, content: bytes) -> bytes:
    """A JSON file with other values or keys, or with damaged text."""
    if random.random() < 0.4:
        return damage_text(random, content)
    return json.dumps(damage_value(random, json.loads(content))).encode()


def parts_of_glb(content: bytes) -> tuple[bytes, bytes]:
    """The JSON and the numbers of a binary glTF."""
    length = int.from_bytes(content[12:16], "little")
    return content[20 : 20 + length], content[28 + length :]


def glb_of(head: bytes, numbers: bytes) -> bytes:
    """A binary glTF with lengths that fit."""
    head += b" " * (-len(head) % 4)
    chunks = len(head).to_bytes(4, "little") + b"JSON" + head
    chunks += len(numbers).to_bytes(4, "little") + b"BIN\0" + numbers
    return b"glTF\2\0\0\0" + (12 + len(chunks)).to_bytes(4, "little") + chunks


def damage_glb(random: Random, content: bytes) -> bytes:
    """A binary glTF with damage to its JSON or its numbers, and often with lengths that fit."""
    if random.random() < 0.3:
        return damage_bytes(random, content)
    head, numbers = parts_of_glb(content)
    if random.random() < 0.6:
        return glb_of(damage_json(random, head), numbers)
    return glb_of(head, damage_bytes(random, numbers))


def damage_array(random: Random, array: np.ndarray) -> np.ndarray:
    """The array with an odd number, of another type, shape or size, or in another order."""
    with np.errstate(all="ignore"):
        match random.integers(5):
            case 0:
                if array.dtype.kind not in "fiu" or not array.size:
                    return array.ravel()[:0]
                changed = array.copy()
                value = np.asarray(random.choice(VALUES)).astype(array.dtype)
                changed.flat[random.integers(array.size)] = value
                return changed
            case 1:
                try:
                    return array.astype(random.choice(DTYPES))
                except (TypeError, ValueError):
                    return np.array("text")
            case 2:
                flat = array.ravel()
                changes = [array[None], flat[:0], flat, np.concatenate([flat, flat])]
                if array.ndim:
                    changes += [array[:1], array[..., :1], array[::-1]]
                    changes.append(np.concatenate([array, array]))
                return changes[random.integers(len(changes))]
            case 3:
                return random.permutation(array) if array.ndim else array[None]
            case _:
                if array.dtype.kind != "f":
                    return array[..., None]
                return array * 10.0 ** random.integers(-300, 300)


def damage_arrays(random: Random, content: bytes) -> bytes:
    """An archive with one of its arrays changed or left out, or with changed bytes."""
    with np.load(io.BytesIO(content)) as archive:
        arrays = dict(archive)
    name = str(random.choice(sorted(arrays)))
    way = random.integers(8)
    if way == 7:
        return damage_bytes(random, content)
    if way == 6:
        del arrays[name]
    else:
        arrays[name] = damage_array(random, arrays[name])
    return archive_of(arrays)


def archive_of(arrays: Arrays) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    return file.getvalue()
