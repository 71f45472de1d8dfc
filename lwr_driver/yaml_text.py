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

try:
    from yaml._yaml import CParser
except ImportError:

    class Loader(yaml.SafeLoader):
        """Safe types, and numbers of YAML 1.2."""

else:

    class Loader(Composer, CParser, SafeConstructor, Resolver):  # type: ignore[misc, no-redef]
        """Safe types, and numbers of YAML 1.2. Composed in Python: libyaml's own composer overflows the stack."""

        def __init__(self, stream: Any) -> None:
            CParser.__init__(self, stream)
            for base in (Composer, SafeConstructor, Resolver):
                base.__init__(self)


class Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Safe dumper, by libyaml where PyYAML has it, that quotes every text `Loader` would read as a number."""


for _kind in (Loader, Dumper):
    _kind.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


def yaml_content(text: str) -> Any:
    """Plain content of a YAML text. Raises yaml.YAMLError, or ValueError, RecursionError... for hostile ones."""
    return yaml.load(text, Loader)
