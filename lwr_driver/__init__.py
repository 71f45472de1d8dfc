"""The arm: its description, its connection, its guards, and the log of a session."""
