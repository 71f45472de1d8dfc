"""One module a verb of `lwr-run`; each holds a click command named `command`."""
