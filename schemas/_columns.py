"""What a table is: named columns with type, unit, frame and meaning, and the check of a file or table against them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import pyarrow as pa

TIME_NS = pa.timestamp("ns", tz="UTC")
COVARIANCE_6X6 = pa.list_(pa.float64(), 36)


class SchemaError(ValueError):
    """A table does not have the columns, types or metadata its schema names."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table.

    Args:
        name: Column name; ends in its unit where it has one.
        type: Arrow type.
        meaning: One sentence for people.
        unit: Unit symbol ("m", "px", "deg", "s", "1"), empty for text and flags.
        frame: Coordinate frame the value is expressed in, empty where none applies.
        nullable: Whether null is a value ("not known"), not an error.
    """

    name: str
    type: pa.DataType
    meaning: str
    unit: str = ""
    frame: str = ""
    nullable: bool = False

    def field(self) -> pa.Field:
        """The Arrow field, with unit, frame and meaning as metadata."""
        metadata = {"unit": self.unit, "meaning": self.meaning}
        if self.frame:
            metadata["frame"] = self.frame
        return pa.field(self.name, self.type, nullable=self.nullable, metadata=metadata)


@dataclass(frozen=True, slots=True)
class TableSchema:
    """A table of the run folder: name, version and columns.

    Args:
        name: The table's name, also the stem of its file or folder.
        version: Raised whenever a column changes its meaning, type or name.
        meaning: One sentence for people.
        columns: The columns in order.
    """

    name: str
    version: int
    meaning: str
    columns: tuple[Column, ...]

    def arrow(self) -> pa.Schema:
        """The Arrow schema with field metadata and the table's own name and version."""
        return pa.schema(
            [column.field() for column in self.columns],
            metadata={"epitransfer:table": self.name, "epitransfer:version": str(self.version)},
        )

    def empty(self) -> pa.Table:
        """A table of no rows."""
        return self.arrow().empty_table()

    def from_columns(self, columns: dict[str, object]) -> pa.Table:
        """A table from one array or sequence per column; every column must be there, and no other.

        Raises:
            SchemaError: A column is missing, unknown or of the wrong type.
        """
        names = {column.name for column in self.columns}
        if missing := names - columns.keys():
            raise SchemaError(f"{self.name}: no values for {', '.join(sorted(missing))}")
        if unknown := columns.keys() - names:
            raise SchemaError(f"{self.name}: no such column {', '.join(sorted(unknown))}")
        try:
            arrays = [pa.array(columns[column.name], column.type) for column in self.columns]
        except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
            raise SchemaError(f"{self.name}: {error}") from error
        table = pa.Table.from_arrays(arrays, schema=self.arrow())
        self.check(table)
        return table

    def from_rows(self, rows: Iterable[dict[str, object]]) -> pa.Table:
        """A table from one mapping per row; absent keys are null."""
        listed = list(rows)
        return self.from_columns({c.name: [row.get(c.name) for row in listed] for c in self.columns})

    def check_schema(self, found: pa.Schema) -> None:
        """Compares a file's schema with this one: names, types, nullability, units and version.

        Raises:
            SchemaError: Anything differs; the message names the first difference.
        """
        expected = self.arrow()
        if found.names != expected.names:
            missing = [name for name in expected.names if name not in found.names]
            extra = [name for name in found.names if name not in expected.names]
            raise SchemaError(f"{self.name}: columns differ (missing {missing}, unexpected {extra})")
        for want in expected:
            have = found.field(want.name)
            # An extension type (the geometry, in a process that knows GeoArrow) is compared by what it stores.
            stored = getattr(have.type, "storage_type", have.type)
            if stored != want.type:
                raise SchemaError(f"{self.name}.{want.name}: found {stored}, expected {want.type}")
            if (have.metadata or {}).get(b"unit") != (want.metadata or {}).get(b"unit"):
                raise SchemaError(f"{self.name}.{want.name}: the unit metadata is lost or changed")
        version = (found.metadata or {}).get(b"epitransfer:version", b"?").decode()
        if version != str(self.version):
            raise SchemaError(f"{self.name}: found version {version}, expected {self.version}")

    def check(self, table: pa.Table) -> None:
        """Compares a table with this schema, its nulls included.

        Raises:
            SchemaError: Anything differs.
        """
        self.check_schema(table.schema)
        for column in self.columns:
            if not column.nullable and table.column(column.name).null_count:
                raise SchemaError(f"{self.name}.{column.name}: null where a value is required")


def text(name: str, meaning: str, *, nullable: bool = False) -> Column:
    """A text column."""
    return Column(name, pa.string(), meaning, nullable=nullable)


def flag(name: str, meaning: str) -> Column:
    """A yes/no column."""
    return Column(name, pa.bool_(), meaning)


def number(name: str, unit: str, meaning: str, *, frame: str = "", nullable: bool = False) -> Column:
    """A float64 column."""
    return Column(name, pa.float64(), meaning, unit, frame, nullable)


def single(name: str, unit: str, meaning: str, *, frame: str = "", nullable: bool = False) -> Column:
    """A float32 column, where single precision is far below the value's own error."""
    return Column(name, pa.float32(), meaning, unit, frame, nullable)


def count(name: str, meaning: str) -> Column:
    """An int64 count."""
    return Column(name, pa.int64(), meaning, "1")


def time_ns(name: str, meaning: str, *, nullable: bool = False) -> Column:
    """A UTC instant in nanoseconds."""
    return Column(name, TIME_NS, meaning, "ns", "UTC", nullable)
