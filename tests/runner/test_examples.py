"""Public recordings: fetched from a server of this computer, checked, never replaced."""

from __future__ import annotations

import functools
import hashlib
import http.server
import json
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from fri.errors import ConfigurationError, DataError, FileError, NetworkError
from runner.cli import main
from runner.examples import EXAMPLES, Example, Remote, fetch

CONTENT = b"t,q,tau\n0,0,1\n"
REAL = Path(__file__).resolve().parents[3] / "shared/data"
PLACES = {"lwr4": "lwr4_flobaroid", "kinova": "kinova_gen3"}


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *words: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    folder = tmp_path / "served"
    folder.mkdir()
    (folder / "arm.csv").write_bytes(CONTENT)
    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=folder)
    ) as here:
        threading.Thread(target=here.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{here.server_address[1]}"
        here.shutdown()


@pytest.fixture(autouse=True)
def bench(monkeypatch: pytest.MonkeyPatch) -> None:
    remote = Remote("https://example.invalid/arm.csv", hashlib.sha256(CONTENT).hexdigest())
    one = Example("a bench arm", "example.invalid", "none stated", (remote,), ("lwr-run info arm.csv",))
    monkeypatch.setitem(EXAMPLES, "bench", one)


def test_a_recording_is_fetched_once_and_kept(server: str, tmp_path: Path) -> None:
    folder = tmp_path / "bench"
    done = CliRunner().invoke(main, ["example", "bench", "--out", str(folder), "--mirror", server])
    assert done.exit_code == 0, done.output
    assert (folder / "arm.csv").read_bytes() == CONTENT
    assert "licence: none stated" in done.stderr
    assert done.stdout.split() == [str(folder / "arm.csv")]
    before = (folder / "arm.csv").stat().st_mtime_ns
    fetch("bench", folder, "http://127.0.0.1:9")
    assert (folder / "arm.csv").stat().st_mtime_ns == before


def test_a_folder_serves_where_there_is_no_internet(server: str, tmp_path: Path) -> None:
    fetch("bench", tmp_path / "bench", str(tmp_path / "served"))
    assert (tmp_path / "bench/arm.csv").read_bytes() == CONTENT
    with pytest.raises(FileError, match=r"arm\.csv cannot be read"):
        fetch("bench", tmp_path / "other", str(tmp_path))


def test_other_content_is_refused_and_nothing_is_left(server: str, tmp_path: Path) -> None:
    (tmp_path / "served/arm.csv").write_text("other")
    for mirror in (server, str(tmp_path / "served")):
        with pytest.raises(DataError, match=r"SHA-256|hash"):
            fetch("bench", tmp_path / "bench", mirror)
        assert list((tmp_path / "bench").iterdir()) == []


def test_a_file_of_the_same_name_is_not_replaced(server: str, tmp_path: Path) -> None:
    (tmp_path / "bench").mkdir()
    (tmp_path / "bench/arm.csv").write_text("mine")
    with pytest.raises(ConfigurationError, match="move it away"):
        fetch("bench", tmp_path / "bench", server)
    assert (tmp_path / "bench/arm.csv").read_text() == "mine"


def test_without_a_connection_the_error_says_what_to_do(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        closed = f"http://127.0.0.1:{probe.getsockname()[1]}"
    with pytest.raises(
        NetworkError, match="check the internet connection, or fetch the file with another computer"
    ):
        fetch("bench", tmp_path / "bench", closed)


def test_an_unknown_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="known: lwr4"):
        fetch("puma", tmp_path)


def test_the_list_names_source_and_licence() -> None:
    entries = json.loads(CliRunner().invoke(main, ["example", "--list", "--json"]).output)
    assert all(entry["licence"] and entry["source"] for entry in entries)
    for example in EXAMPLES.values():
        for remote in example.files:
            assert re.fullmatch(r"[0-9a-f]{64}", remote.sha256)


@pytest.mark.parametrize("name", PLACES)
def test_the_sums_are_those_of_the_real_files(name: str, tmp_path: Path) -> None:
    place = REAL / PLACES[name]
    if not place.is_dir():
        pytest.skip(f"{place} is not there")
    assert len(fetch(name, tmp_path / name, str(place))) == len(EXAMPLES[name].files)
