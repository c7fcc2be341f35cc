"""Lists that explain: the parameters of a system, the keys of an experiment file."""
