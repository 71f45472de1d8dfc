"""Planned motions: criteria, computing time and safety, and an experiment with each."""
