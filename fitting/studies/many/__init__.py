"""Many fits at once (`fit_many`), and many systems on many clips (`evaluation`)."""
