"""The commands of `lwr-run`, one module per family."""
