"""The search of the site in a page opened from a folder: its shim comes from the site itself, not from the network."""

from __future__ import annotations

from typing import Any

_FETCHED = "https://unpkg.com/iframe-worker/shim"


def on_post_page(output: str, page: Any, config: Any) -> str:
    """The page with its own copy of the shim. Called by mkdocs."""
    return output.replace(_FETCHED, "iframe-worker.js")


def on_post_template(output: str, template_name: str, config: Any) -> str:
    """The same for pages without a document, such as 404.html. Called by mkdocs."""
    return output.replace(_FETCHED, "iframe-worker.js")
