"""How large the workloads of the benchmarks are, and how often each call runs."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Sizes:
    """Sizes of workloads and numbers of runs; the defaults are those of a full run."""

    repeats: int = 7
    """Samples of each call."""
    legs: int = 200_000
    feet: int = 100_000
    characters: int = 4096
    frames: int = 600
    """Of a clip; 10 s."""
    derived: int = 512
    """Characters whose gradient is taken."""
    chunk: int = 64
    """Characters computed at once."""
    crowd_repeats: int = 3
    """Samples of a crowd and of rays."""
    cells: int = 500
    """Along a side of the mesh; 2 cells² triangles."""
    rays: int = 1_000_000
    read: int = 1 << 26
    """Floats read to measure memory bandwidth."""
    side: int = 2048
    """Of the matrices multiplied to measure arithmetic."""
    fits: int = 3
    """Samples of warm fits, and of cold fits of each kind."""
    cold: bool = True
    """Whether to run cold fits, and SciPy with finite differences."""
    floats: tuple[str, ...] = ("float64", "float32")
    """Of the residuals."""
    walkers: int = 64
    steps: int = 1000
    """Of the sampler."""
    chains: int = 1
    """Samples of the sampler."""
    # Sizes of the scaling curves.
    batches: tuple[int, ...] = (2, 10, 100, 1000, 10_000, 100_000, 1_000_000)
    """Legs."""
    lengths: tuple[int, ...] = (100, 1000, 10_000, 100_000)
    """Frames."""
    grids: tuple[int, ...] = (7, 22, 71, 224, 707, 2236)
    """Cells a side: 10² to 10⁷ triangles."""
    parameters: tuple[int, ...] = (5, 10, 20, 40)
    legs_each: tuple[int, ...] = (2, 4, 6, 8)
    devices: tuple[int, ...] = (1, 2, 4, 8)
    clips: tuple[int, ...] = (10, 100, 1000)
    workers: tuple[int, ...] = (1, 2, 4)


FULL = Sizes()
QUICK = Sizes(
    repeats=3, characters=64, derived=64, cells=200, rays=200_000, read=1 << 24, crowd_repeats=2,
    fits=1, cold=False, floats=("float64",), steps=20,
    batches=(100, 1000, 10_000), lengths=(100, 1000), grids=(22, 71), parameters=(5, 20),
    legs_each=(2, 4), devices=(1, 2), clips=(10, 100), workers=(1, 2),
)  # fmt: skip
