"""The jobs and the folder of a run."""
