"""Random staircases: `PYTHONPATH=tests python -m stairs`."""
