"""Plain NumPy float64 references: one character, one frame at a time, written from the rules."""
