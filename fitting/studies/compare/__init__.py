"""Several systems on one clip: how far apart they are, and how each stands on its ground."""
