"""The table contracts of ``schemas/parquet`` as Arrow schemas; the only reader of these files."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import pyarrow as pa

from semloc_logs.errors import ContractError
from semloc_logs.schemas import names, read_text

_TYPES = {
    "bool": pa.bool_(),
    "uint8": pa.uint8(),
    "uint16": pa.uint16(),
    "int32": pa.int32(),
    "int64": pa.int64(),
    "uint64": pa.uint64(),
    "float32": pa.float32(),
    "float64": pa.float64(),
    "string": pa.string(),
    "fixed_size_binary[4096]": pa.binary(4096),
    "list<cell,label,count>": pa.list_(
        pa.field(
            "item",
            pa.struct(
                [
                    pa.field("cell", pa.uint16()),
                    pa.field("label", pa.uint8()),
                    pa.field("count", pa.uint32()),
                ]
            ),
            nullable=True,
        )
    ),
    "fixed_size_list<double>[36]": pa.list_(pa.float64(), 36),
}


@cache
def schema(name: str) -> pa.Schema:
    """Columns and types of the table ``name``."""
    return pa.schema(
        [pa.field(c["name"], _TYPES[c["type"]], nullable=False) for c in contract(name)["columns"]]
    )


@cache
def contract(name: str) -> dict[str, Any]:
    """The contract as written: version, meaning, and its columns."""
    content: dict[str, Any] = json.loads(read_text(f"parquet/{name}.json"))
    return content


def tables() -> list[str]:
    """Names of all table contracts."""
    return list(names("parquet", ".json"))


def table(name: str, columns: dict[str, Any]) -> pa.Table:
    """A table of the contract ``name`` from its columns; ContractError when they differ from it."""
    wanted = schema(name)
    if set(columns) != set(wanted.names):
        raise ContractError(
            f"Table '{name}' needs the columns {', '.join(wanted.names)}, not {', '.join(columns)}."
        )
    try:
        return pa.table([pa.array(columns[f.name], f.type) for f in wanted], schema=wanted)
    except (pa.ArrowException, OverflowError) as problem:
        raise ContractError(
            f"Table '{name}' cannot hold these columns: {str(problem).splitlines()[0]}."
        ) from None
