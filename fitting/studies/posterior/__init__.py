"""What a sampled posterior says of its fit.

`contradictions` finds where chain and fit disagree.
"""
