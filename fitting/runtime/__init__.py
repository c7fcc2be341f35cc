"""How programs run here: XLA settings, threads, kept programs, files written whole."""
