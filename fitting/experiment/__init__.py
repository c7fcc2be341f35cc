"""The files of the user: experiments, systems with their parameters, ablations.

Reading a file checks every key and value; messages say what is wrong, where, and what is wanted;
`problems` then loads the clips and builds the `Problem` that is minimised. Nothing is computed or
written here. Start with `experiment.Experiment`, then `experiment_files` for the file format.
"""
