"""Animation files in: what they say, how they are understood, what may be cut from them."""

from .clip import Clip as Clip
from .formats.npz import save_clip as save_clip
from .load import load_clip as load_clip
