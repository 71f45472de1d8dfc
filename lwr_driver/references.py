"""The files that configuration files name: noted while they are read, and frozen as copies with their SHA-256.

Frozen files lie in `FOLDER/files/`, one folder for each folder of origin, with the manifest `files.json`: origin and
hash of each file, and the file behind each name. A name beside a frozen file is resolved by the manifest alone, so a
later run reads what the first one read, or is refused.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fri.errors import ConfigurationError, naming

FOLDER = "files"
MANIFEST = "files.json"

_noted: ContextVar[list[Reference] | None] = ContextVar("references", default=None)


@dataclass(frozen=True)
class Reference:
    """A file found by its name. beside : folder of the file naming it."""

    beside: Path
    name: str
    path: Path


@dataclass(frozen=True)
class UsedFile:
    """A file of an experiment: its path at the start, its SHA-256, its frozen copy relative to `files/`."""

    path: Path
    sha256: str
    file: str

    def __str__(self) -> str:
        return f"{self.sha256}  {self.path}"


@contextlib.contextmanager
def noting() -> Iterator[list[Reference]]:
    """Collect the files that `configuration.find` finds within the block."""
    found: list[Reference] = []
    token = _noted.set(found)
    try:
        yield found
    finally:
        _noted.reset(token)


def note(beside: Path | None, name: str, path: Path) -> None:
    """A file was found; names from the command line, without `beside`, are not noted."""
    found = _noted.get()
    if found is not None and beside is not None:
        found.append(Reference(beside.resolve(), name, path))


def used(root: Path, references: Sequence[Reference]) -> list[UsedFile]:
    """The file `root` and those behind references, each once, with their hashes and places of their copies."""
    folders: dict[Path, str] = {}
    files: dict[Path, UsedFile] = {}
    for path in (root.resolve(), *(reference.path for reference in references)):
        if path.parent not in folders:
            name = path.parent.name or "root"
            taken = sum(other == name or other.startswith(f"{name}-") for other in folders.values())
            folders[path.parent] = f"{name}-{taken + 1}" if taken else name
        if path not in files:
            files[path] = UsedFile(path, sha256(path), f"{folders[path.parent]}/{path.name}")
    return list(files.values())


def freeze(root: Path, references: Sequence[Reference], target: Path) -> list[UsedFile]:
    """Copy the file `root` and those behind references into `target/files/` with their manifest; returns them."""
    files = used(root, references)
    by_path = {file.path: file.file for file in files}
    home = target / FOLDER
    for file in files:
        copy = home / file.file
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file.path, copy)
        if sha256(copy) != file.sha256:
            raise ConfigurationError(f"{file.path} changed while it was read; start again")
    folders = {file.path.parent: file.file.partition("/")[0] for file in files}
    named = [
        {"folder": folders.get(one.beside, ""), "name": one.name, "file": by_path[one.path]}
        for one in references
    ]
    content = {
        "schema_version": 1,
        "root": by_path[root.resolve()],
        "files": [{"path": str(f.path), "sha256": f.sha256, "file": f.file} for f in files],
        "references": [entry for index, entry in enumerate(named) if entry not in named[:index]],
        "made": {},
    }
    _write(home / MANIFEST, content)
    return files


def frozen_file(beside: Path, name: str) -> Path | None:
    """The frozen file behind a name in the frozen folder `beside`; None if nothing is frozen there.

    Raises ConfigurationError for a name unknown to the manifest, or a file that changed since. Absolute paths outside
    the manifest are left to the caller.
    """
    home = beside.parent
    if home.name != FOLDER or not (home / MANIFEST).is_file():
        return None
    manifest = _read(home / MANIFEST)
    for entry in manifest["references"]:
        if entry["name"] == name and entry["folder"] == beside.name:
            return _unchanged(home, entry["file"], manifest)
    if os.path.isabs(name):
        return None
    raise ConfigurationError(
        f"file {name[:80]!r} is not among the files frozen in {home}; start a new experiment to use it"
    )


@dataclass(frozen=True)
class Frozen:
    """The frozen files of the results folder `folder`."""

    folder: Path

    @property
    def there(self) -> bool:
        """Whether the folder holds frozen files."""
        return self._manifest_path.is_file()

    @property
    def _manifest_path(self) -> Path:
        return self.folder / FOLDER / MANIFEST

    @property
    def manifest(self) -> bytes:
        """Text of the manifest, for a log."""
        return self._manifest_path.read_bytes()

    def files(self) -> list[UsedFile]:
        """All frozen files, as noted at the start."""
        entries = _read(self._manifest_path)["files"]
        return [UsedFile(Path(entry["path"]), entry["sha256"], entry["file"]) for entry in entries]

    def root(self) -> Path:
        """The file named on the command line."""
        manifest = _read(self._manifest_path)
        return _unchanged(self.folder / FOLDER, manifest["root"], manifest)

    def check(self) -> None:
        """Raise ConfigurationError if a frozen file changed."""
        manifest = _read(self._manifest_path)
        for entry in manifest["files"]:
            _unchanged(self.folder / FOLDER, entry["file"], manifest)

    def edited(self) -> list[UsedFile]:
        """Files whose originals exist, but differ from the frozen copies."""
        return [file for file in self.files() if file.path.is_file() and sha256(file.path) != file.sha256]

    def keep(self, name: str) -> None:
        """Note the hash of a file made in the results folder, such as a plan."""
        manifest = _read(self._manifest_path)
        manifest["made"][name] = sha256(self.folder / name)
        _write(self._manifest_path, manifest)

    def kept(self, name: str) -> bool:
        """Whether a file made by this experiment is there; ConfigurationError if it changed since."""
        known = _read(self._manifest_path)["made"].get(name)
        if known is None or not (self.folder / name).is_file():
            return False
        if sha256(self.folder / name) != known:
            raise ConfigurationError(
                f"{self.folder / name} changed since it was made (SHA-256 {known[:12]}...); put it back, or start a "
                "new experiment"
            )
        return True


def sha256(path: Path) -> str:
    """Hash of a file, hexadecimal; ConfigurationError if it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error


def _unchanged(home: Path, file: str, manifest: dict[str, Any]) -> Path:
    known = next((entry["sha256"] for entry in manifest["files"] if entry["file"] == file), None)
    path = home / file
    if known is None or not path.is_file() or sha256(path) != known:
        state = "changed" if path.is_file() else "is missing"
        raise ConfigurationError(
            f"{path} {state} since the start of the experiment; put the copy back, or start a new experiment"
        )
    return path


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        for key, kind in (("root", str), ("files", list), ("references", list), ("made", dict)):
            if not isinstance(content[key], kind):
                raise ValueError(f"`{key}` is no {kind.__name__}")
        for entry in (*content["files"], *content["references"]):
            if (
                not all(isinstance(value, str) for value in entry.values())
                or ".." in Path(entry["file"]).parts
            ):
                raise ValueError(f"{entry!r:.80} is no entry")
        return dict(content)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}; start a new experiment") from error


def _write(path: Path, content: dict[str, Any]) -> None:
    draft = path.with_suffix(".json.new")
    with naming(draft), draft.open("w", encoding="utf-8") as stream:
        json.dump(content, stream, indent=1)
        stream.flush()
        os.fsync(stream.fileno())
    draft.replace(path)
