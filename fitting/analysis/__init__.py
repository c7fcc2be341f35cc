"""Numbers about motion."""
