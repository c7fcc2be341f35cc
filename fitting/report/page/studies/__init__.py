"""Pages of jobs that fit many times: ablations, populations and calibrations."""
