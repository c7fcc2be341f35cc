"""Results for those who go on with them: what notebooks show, and tables for pandas."""
