"""The user's programs: command line, experiment, doctor, preflight, preview, report."""
