"""Is what is said of uncertainty true? Statistics of many fits whose truth is known.

`rank_bands` judges the ranks of truths among posterior draws, `proportions` how often something
holds, such as an interval containing the truth. Both are exact or simulated; neither uses JAX.
"""
