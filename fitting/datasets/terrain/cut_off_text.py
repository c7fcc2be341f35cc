"""Meshes as text that end too early, which trimesh loads with what is there."""

from collections.abc import Callable, Sequence


def check_whole(kind: str, content: bytes) -> None:
    """Checks that a text has all that it announces.

    Args:
        kind: of the file, such as "ply". Binary files, and formats that announce nothing, pass:
            the former fail where they are read.
        content: of the file.

    Raises:
        ValueError: with what is announced and what there is.
    """
    if kind in COUNTS:
        announced, lines = COUNTS[kind](content)
        rows = [words for line in lines if (words := line.split())]
        if len(rows) < announced:
            raise ValueError(
                f"the file is cut off: its head announces {announced} lines of vertices and faces, "
                f"there are {len(rows)}"
            )
        if announced and _is_short(rows[announced - 1]):
            raise ValueError(f"the file is cut off in line {announced} after its head")
    text = content.lower()
    if kind == "stl" and text.lstrip().startswith(b"solid") and b"\0" not in text:
        if b"endsolid" not in text:
            count = text.count(b"endfacet")
            raise ValueError(f"the file is cut off after {count} triangles: it has no endsolid")


def _of_ply(content: bytes) -> tuple[int, Sequence[bytes]]:
    head, _, body = content.partition(b"end_header")
    rows = [line.split() for line in head.splitlines()]
    if [b"format", b"ascii"] not in [row[:2] for row in rows]:
        return 0, ()
    elements = [row[2] for row in rows if len(row) == 3 and row[0] == b"element"]
    return sum(int(count) for count in elements if count.isdigit()), body.splitlines()


def _of_off(content: bytes) -> tuple[int, Sequence[bytes]]:
    lines = [line.partition(b"#")[0] for line in content.splitlines()]
    body = b"\n".join(lines).partition(b"OFF")[2].strip().splitlines()
    counts = body[0].split()[:2] if body else []
    return sum(int(count) for count in counts if count.isdigit()), body[1:]


def _is_short(row: Sequence[bytes]) -> bool:
    """Whether a face has fewer corners than its first number says."""
    return row[0].isdigit() and int(row[0]) > 2 and len(row) <= int(row[0])


# By kind: how many lines are announced, and those that follow the head.
COUNTS: dict[str, Callable[[bytes], tuple[int, Sequence[bytes]]]] = {"ply": _of_ply, "off": _of_off}
