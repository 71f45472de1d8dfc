"""YAML as plain content: parsed by libyaml where PyYAML has it, ten times faster, else by Python."""

from __future__ import annotations

import re
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

_FLOAT = re.compile(
    r"^[-+]?(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)[eE][-+]?[0-9]+$"
)  # as YAML 1.2: `5e-05` too

_MERGE = "tag:yaml.org,2002:merge"


class RepeatedKeyError(yaml.YAMLError):
    """A mapping has a key twice, where the last one would win. key; first, second : lines of it, from 1."""

    def __init__(self, key: str, first: int, second: int) -> None:
        super().__init__(f"key `{key}` stands twice, in line {first} and in line {second}")
        self.key, self.first, self.second = key, first, second


class _OneOfEach(Composer):
    """Composes mappings without repeated keys; `<<` may merge several times."""

    def compose_mapping_node(self, anchor: Any) -> Any:
        """A mapping; RepeatedKeyError for a key that it has already."""
        node = super().compose_mapping_node(anchor)
        seen: dict[tuple[str, str], int] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                named, line = (key.tag, key.value), key.start_mark.line + 1
                if named in seen:
                    raise RepeatedKeyError(key.value, seen[named], line)
                seen[named] = line
        return node


try:
    from yaml._yaml import CParser
except ImportError:

    class Loader(_OneOfEach, yaml.SafeLoader):
        """Safe types, and numbers of YAML 1.2."""

else:

    class Loader(_OneOfEach, CParser, SafeConstructor, Resolver):  # type: ignore[misc, no-redef]
        """Safe types, and numbers of YAML 1.2. Composed in Python: libyaml's own composer overflows the stack."""

        def __init__(self, stream: Any) -> None:
            CParser.__init__(self, stream)
            for base in (_OneOfEach, SafeConstructor, Resolver):
                base.__init__(self)


class Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Safe dumper, by libyaml where PyYAML has it. It quotes every text that `Loader` would read as a number."""


for _kind in (Loader, Dumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def yaml_content(text: str) -> Any:
    """Plain content of a YAML text. Raises yaml.YAMLError, or ValueError, RecursionError... for hostile ones."""
    return yaml.load(text, Loader)
