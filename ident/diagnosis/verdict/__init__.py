"""From claims to the diagnosis: tests on held-out rows, confidence, models."""
