"""Pages of comparisons: of systems on a clip, of systems in the suite, and of sampled runs."""
