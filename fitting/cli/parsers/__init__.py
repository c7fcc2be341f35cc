"""Words and options of the commands, by what the commands do. Imports no JAX."""
