"""A finished system on clips: the solved motion, at several frame rates, and how it stands."""
