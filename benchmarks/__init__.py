"""Measurements of the software, each run from the project's root: `python -m benchmarks.NAME`."""
