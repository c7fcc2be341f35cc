"""Several clips and subjects: each alone, all pooled, and as a population; clips left out in turn.

Start with `population.py`. `kept_searches.py` keeps on disk what takes the time, `left_out.py`
predicts each clip from the others, and `estimates.py` holds the numbers of the result.
"""
