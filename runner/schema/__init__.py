"""JSON Schemas of the files that people write, and tables of their keys, from the declarations of the readers."""

from runner.schema.schemas import FILES, SCHEMAS, schema, schema_text, write_schemas
from runner.schema.tables import rows, table

__all__ = ["FILES", "SCHEMAS", "rows", "schema", "schema_text", "table", "write_schemas"]
