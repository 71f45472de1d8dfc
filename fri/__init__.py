"""The Fast Research Interface 1.0: packets, state machine, and both ends of the socket."""

from fri import compiler_cache

compiler_cache.provide()
