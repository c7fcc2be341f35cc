"""Jobs that are shared out to many processes."""
