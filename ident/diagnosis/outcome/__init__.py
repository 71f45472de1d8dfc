"""A diagnosis as a value, in words, and with its look-alikes."""
