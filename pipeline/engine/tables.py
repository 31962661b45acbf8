"""Parquet files of the run folder: one way to write them, one way to read them with their schema checked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from pipeline.engine.errors import InputError
from schemas import TABLES, SchemaError

_ROW_GROUP = 131_072


def write_table(path: Path, table: pa.Table) -> None:
    """Writes a table so that equal tables give equal bytes: zstd, byte-stream-split floats, dictionaries on text."""
    write_pieces(path, table.schema, [table])


def write_pieces(path: Path, schema: pa.Schema, pieces: Iterable[pa.Table]) -> None:
    """As `write_table`, from pieces that need not fit into memory together."""
    floats = [field.name for field in schema if pa.types.is_floating(field.type)]
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    with pq.ParquetWriter(
        path,
        schema,
        compression="zstd",
        compression_level=3,
        use_dictionary=texts,
        use_byte_stream_split=floats,
        write_page_checksum=True,
    ) as writer:
        for piece in pieces:
            writer.write_table(piece, row_group_size=_ROW_GROUP)


def parquet_files(path: Path) -> list[Path]:
    """The Parquet files of a table: the file itself, or a dataset folder's parts in order."""
    return [path] if path.is_file() else sorted(path.glob("*.parquet"))


def read_table(path: Path, name: str) -> pa.Table:
    """Reads a table or a dataset's parts as one table.

    Raises:
        InputError: Missing, unreadable, or not of the schema `name`.
    """
    schema = TABLES[name]
    files = parquet_files(path)
    if not path.exists():
        raise InputError("E-TABLE-01", f"the table {name} is missing", where=str(path), hint="run the stage before")
    tables = []
    for file in files:
        with explained(file, name):
            tables.append(pq.read_table(file, partitioning=None, page_checksum_verification=True))
            schema.check_schema(tables[-1].schema)
    return pa.concat_tables(tables) if tables else schema.empty()


def check_stored(path: Path, name: str) -> None:
    """Compares the schemas of a table's or dataset's files with the table's; reads no rows.

    Raises:
        InputError: No files, unreadable, or not of the schema `name`.
    """
    files = parquet_files(path)
    if not files:
        raise InputError(
            "E-TABLE-04", f"the table {name} has no parts", where=str(path), hint="rerun the stage that writes it"
        )
    for file in files:
        # Extension types (the geometry) are compared by what they store.
        with explained(file, name), pq.ParquetFile(file, arrow_extensions_enabled=False) as stored:
            TABLES[name].check_schema(stored.schema_arrow)


def dataset(path: Path) -> ds.Dataset:
    """A dataset's parts, to be read in pieces and with the checksums of their pages; within `explained`."""
    options = ds.ParquetFragmentScanOptions(page_checksum_verification=True)
    return ds.dataset(path, format=ds.ParquetFileFormat(default_fragment_scan_options=options))


@contextmanager
def explained(path: Path, name: str) -> Iterator[None]:
    """Turns what Arrow raises on a damaged file of a table into an error that names it.

    Raises:
        InputError: Unreadable, or not of the schema `name`.
    """
    try:
        yield
    except MemoryError:
        raise
    except SchemaError as error:
        raise InputError(
            "E-TABLE-02",
            f"the table {name} is of another schema",
            where=str(path),
            found=str(error),
            hint="rerun the stage that writes it",
        ) from error
    except (pa.ArrowException, OSError) as error:
        raise InputError(
            "E-TABLE-03",
            f"the table {name} cannot be read",
            where=str(path),
            found=str(error),
            hint="rerun the stage that writes it",
        ) from error
