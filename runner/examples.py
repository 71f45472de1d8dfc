"""Public recordings of real arms: fetched from their authors' place, each file checked by its SHA-256.

Nothing of them is part of this software; every recording has its own licence.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from fri.errors import ConfigurationError, DataError, FileError, NetworkError


@dataclass(frozen=True)
class Remote:
    """A file: URL, and SHA-256 in hexadecimal digits."""

    url: str
    sha256: str

    @property
    def name(self) -> str:
        """Its name in the folder of the example."""
        return self.url.rpartition("/")[2]


@dataclass(frozen=True)
class Example:
    """A public recording.

    meaning : arm and content. source : its authors' place. licence : theirs. then : commands to go on with, in the
    folder of the files.
    """

    meaning: str
    source: str
    licence: str
    files: tuple[Remote, ...]
    then: tuple[str, ...]


_LWR4 = (
    "https://raw.githubusercontent.com/kjyv/FloBaRoID/e6c077ea5c09bceb49840f49e83450bb5979029b/data/KUKA/HW"
)
_GEN3 = "https://raw.githubusercontent.com/wissem01chiha/dynamic-identification"
_GEN3_NEW = f"{_GEN3}/3b3baefc69a0587fc82a19f43560dfdb020bb852/pyDynaMapp"
_GEN3_OLD = f"{_GEN3}/ba6035215f0186bbaab65d79c7247f65a219abf8"

EXAMPLES = {
    "lwr4": Example(
        "KUKA LWR4+: joint positions and torque sensors, three runs of 25 s at 200 Hz",
        "github.com/kjyv/FloBaRoID",
        "LGPL-3.0, see LICENSE.md of the source",
        (
            Remote(f"{_LWR4}/measurements_1.npz", "55b94c07e86a75311a584cc945c4436e7a5dbeafd5f7378a53225a0dd820c1fd"),
            Remote(f"{_LWR4}/measurements_2.npz", "e15b6df10dd26ecdd3f870bf9a908184207db26f13ae34b9e96931ab9fa14de8"),
            Remote(f"{_LWR4}/measurements_3.npz", "4ca527bbac6d6f299e9478451c6b1f059672bf38859e218b0b37fc20bd783acd"),
        ),
        (
            "lwr-run import lwr4_flobaroid measurements_1.npz run_1.mcap",
            "lwr-run import lwr4_flobaroid measurements_3.npz run_3.mcap",
            "lwr-run identify run_1.mcap --model 1 --out model.yaml --test run_3.mcap",
            "lwr-run diagnose run_1.mcap run_3.mcap --out diagnosis",
        ),
    ),
    "kinova": Example(
        "Kinova Gen3: joint torque sensors and motor currents, two short motions at 1 kHz",
        "github.com/wissem01chiha/dynamic-identification",
        "CC0-1.0",
        (
            Remote(
                f"{_GEN3_OLD}/data/kinova/validation_data/opti_traj_testing1.csv",
                "0c9229ae8882a43fb1aac59c1b527a0942a99dcb0fe2aed77e948091fe8bf274",
            ),
            Remote(
                f"{_GEN3_NEW}/data/kinova/validation_data/opti_traj_testing2.csv",
                "e8e27ef2f4943a3a5b3632c319731473747507e58a512b29adde48a9d4769440",
            ),
            Remote(
                f"{_GEN3_NEW}/robot/kinova/gen3.urdf",
                "798b384976d9e847f8896e29ac58b0581c1dbcb6bad2d5d8ed9474841b38e1f8",
            ),
        ),
        (
            "lwr-run identify opti_traj_testing1.csv --urdf gen3.urdf --model 1 --yes --out model.yaml "
            "--test opti_traj_testing2.csv",
        ),
    ),
}  # fmt: skip
"""The recordings, by name. URLs name a commit, so that their content cannot change."""


def fetch(name: str, folder: Path, mirror: str | None = None) -> list[Path]:
    """Fetch the files of an example into a folder; a file that is there already is only checked.

    mirror : folder or URL with the same files, in place of the source.

    Raises ConfigurationError for an unknown example or a file of another content, NetworkError if the source cannot
    be reached, DataError if it sends other content.
    """
    if name not in EXAMPLES:
        raise ConfigurationError(f"example {name!r} is unknown; known: {', '.join(EXAMPLES)}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError.of(error, f"{folder} cannot be made") from error
    return [_fetch(remote, folder / remote.name, mirror) for remote in EXAMPLES[name].files]


def _fetch(remote: Remote, target: Path, mirror: str | None) -> Path:
    import pooch

    if target.exists():
        if pooch.file_hash(str(target)) != remote.sha256:
            raise ConfigurationError(
                f"{target}: there is another file of this name; move it away, or choose another --out"
            )
        return target
    if mirror is not None and "://" not in mirror:
        source = Path(mirror) / remote.name
        try:
            found = pooch.file_hash(str(source))
        except OSError as error:
            raise FileError.of(error, f"{source} cannot be read") from error
        if found != remote.sha256:
            raise DataError(f"{source}: SHA-256 {found}, expected {remote.sha256}; copy it from {remote.url}")
        shutil.copyfile(source, target)
        return target
    url = remote.url if mirror is None else f"{mirror.rstrip('/')}/{remote.name}"
    pooch.get_logger().setLevel("ERROR")
    try:
        pooch.retrieve(url, f"sha256:{remote.sha256}", fname=target.name, path=target.parent)
    except ValueError as error:
        raise DataError(f"{url}: {error}; the file may be damaged on its way, try again") from error
    except OSError as error:
        raise NetworkError(
            f"{url}: cannot be fetched ({type(error).__name__}); check the internet connection, or fetch the file "
            f"with another computer, put it into {target.parent} and repeat the command: it checks what is there"
        ) from error
    return target
