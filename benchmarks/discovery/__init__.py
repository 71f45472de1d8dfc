"""Hidden causes in simulated sessions, diagnosed and judged against the truth."""
