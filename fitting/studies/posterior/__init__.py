"""What a sampled posterior says of its fit, and of motion.

`contradictions` finds where chain and fit disagree. `replay` runs draws through the clips. From
their motion follow the log-likelihood of blocks of frames (`likelihoods`), and how the capture
compares with what the posterior would make (`predictive`).
"""
