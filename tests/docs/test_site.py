"""The documentation site: built strictly, nothing fetched, its pages true to the code."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from playwright.sync_api import Browser

from runner.cli import VERBS
from tests.docs.markdown import DOCUMENTS, ROOT
from tests.runner.report.view_rig import NARROW, WIDE, flaws, opened

PAGES: dict[str, Any] = runpy.run_path(str(ROOT / "docs/site_pages.py"))
WIDEST = 120
PROSE = (*DOCUMENTS, Path("CHANGELOG.md"))


SHOWN = ("index.html", "identification.html")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    target = tmp_path_factory.mktemp("built") / "site"
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(target)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return target


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_fetches_nothing(site: Path) -> None:
    pages = list(site.glob("*.html"))
    assert len(pages) >= 30
    for page in pages:
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(r"<(?:script|img|iframe)\b[^>]*\bsrc=\"(https?:[^\"]*)\"", text)
        fetched += re.findall(
            r"<link\b[^>]*rel=\"(?:stylesheet|preconnect|icon)\"[^>]*href=\"(https?:[^\"]*)\"", text
        )
        assert fetched == [], page.name
        for target in re.findall(r"<img\b[^>]*\bsrc=\"([^\":]+)\"", text):
            assert (page.parent / target).is_file(), f"{page.name}: {target}"


@pytest.mark.slow
def test_the_site_is_accessible_and_fits_the_window(site: Path, chrome: Browser) -> None:
    for name in SHOWN:
        for size in (WIDE, NARROW):
            with opened(chrome, site / name, size) as seen:
                seen.page.wait_for_timeout(700)
                assert flaws(seen) == [], f"{name} at {size[0]} px"


def test_every_command_and_option_is_on_the_page_of_commands() -> None:
    text = PAGES["commands_page"]()
    assert re.findall(r"^## ([a-z]+)$", text, re.MULTILINE) == list(VERBS)
    assert "`--refer`" in text


def strings() -> str:
    """Every text of the code, `...` for values in it."""
    found = []
    for package in PAGES["PACKAGES"]:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, (ast.Constant, ast.JoinedStr)):
                    found.append(PAGES["_template"](node))
    return "\n".join(found)


def test_every_message_that_troubleshooting_explains_is_one_of_the_code() -> None:
    page = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    explained = re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)
    assert len(explained) > 25
    known = strings()
    for words in explained:
        assert words in known, words


def test_the_page_of_messages_has_every_error_that_is_raised() -> None:
    text = PAGES["messages_page"]()
    assert text.count("\n- ") > 500
    assert "unknown key `...`; ..." in text
    for who in ("exit code 3", "exit code 5", "exit code 6", "exit code 7"):
        assert who in text


@pytest.mark.parametrize("document", PROSE, ids=str)
def test_prose_is_wrapped(document: Path) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    prose = re.sub(
        r"^```.*?^```$|^\$\$.*?^\$\$$|^(?:!\[|\|)[^\n]*$", "", text, flags=re.MULTILINE | re.DOTALL
    )
    # A code span or a link cannot be broken.
    long = [
        line for line in prose.splitlines() if len(line) > WIDEST and not re.match(r"^\s*`[^`]*`\S*$", line)
    ]
    assert long == []


def test_every_picture_is_shown_and_described() -> None:
    shown: dict[str, str] = {}
    for page in (*(ROOT / "docs").glob("*.md"), ROOT / "README.md"):
        for words, file in re.findall(
            r"!\[([^\]]*)\]\((?:docs/)?images/([^)]+)\)", page.read_text(encoding="utf-8")
        ):
            shown[file] = words
    there = {path.name for path in (ROOT / "docs/images").iterdir() if path.suffix in (".svg", ".png")}
    assert set(shown) == there
    assert len(there) >= 30
    assert all(len(words) > 15 for words in shown.values())


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    named = set(re.findall(r"([\w.]+\.md)$", text, re.MULTILINE))
    files = {path.name for path in (ROOT / "docs").glob("*.md")} | set(PAGES["generated"]())
    assert named == files
    assert yaml.safe_load(text)["theme"]["font"] is False
