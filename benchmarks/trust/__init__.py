"""The campaign: do driver and log survive what a lab does to them? See `python -m benchmarks.trust`."""
