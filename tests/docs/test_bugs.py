"""The bugs written by hand can still be put in, and the tests that must notice them exist."""

from __future__ import annotations

import re

import pytest

from benchmarks.mutation.bugs import BUGS, Bug
from tests.docs.markdown import ROOT


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_a_bug_is_where_the_table_has_it(bug: Bug) -> None:
    source = (ROOT / bug.file).read_text("utf-8")
    assert source.count(bug.old) == 1, f"{bug.file} has changed; mend the row of benchmarks/mutation/bugs.py"
    compile(source.replace(bug.old, bug.new), bug.file, "exec")
    for test in bug.tests:
        file, function = test.split("::")
        assert re.search(rf"^def {function}\(", (ROOT / file).read_text("utf-8"), re.MULTILINE), test
