"""Do the tests notice a changed line? Run `python -m benchmarks.mutation [--sample 400] [--seed 1]`.

A mutant is a copy of the project with one small change: another operator, another number, a condition negated, a
statement removed, two arguments swapped. The tests that run the changed line should fail. The mutants are made with
the operators of cosmic-ray and a few more (`mutants`). The tests of a line are known from a run of all tests with
coverage, once (`exercise`). Each mutant is tried in a copy of the tree, in a process of its own (`trial`).

`--bugs` replays the bugs of `bugs.BUGS`: changes of whole terms, written by hand, each with the tests that notice it.

`pip install 'lwr-identification[mutation]'` installs what it needs.
"""
