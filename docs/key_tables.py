"""Writes schemas, key tables and the settings template anew from the declarations: python docs/key_tables.py."""

from __future__ import annotations

from pathlib import Path

from runner.schema.schemas import write_schemas
from runner.schema.tables import TEMPLATE, settings_template, write_documents

if __name__ == "__main__":
    write_schemas()
    TEMPLATE.write_text(settings_template(), encoding="utf-8")
    write_documents(Path(__file__).parent)
