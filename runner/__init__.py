"""The user's programs: command line, experiment, doctor, preflight, preview, replay, report."""
