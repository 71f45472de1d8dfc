"""The dynamic model of a serial arm and everything that is learned about it from session logs."""
