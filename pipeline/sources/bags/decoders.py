"""From a message's bytes to an object with the fields of its type, for the encodings that bags use."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from pipeline.sources.bags.container import Raw, Topic

ENCODINGS = ("ros1", "cdr", "protobuf", "json")
Decoder = Callable[[Raw], Any]

_IDL_SEPARATOR = "=" * 80 + "\n"


class UndecodableError(ValueError):
    """A message or its type that cannot be decoded."""


def decoder(topic: Topic) -> Decoder:
    """What decodes the messages of a topic.

    Args:
        topic: With its schema.

    Returns:
        A function that raises `UndecodableError`.

    Raises:
        UndecodableError: The encoding or the schema is not known.
    """
    if topic.encoding in {"ros1", "cdr"}:
        return _ros(topic.encoding, topic.type, topic.schema_encoding, topic.schema)
    if topic.encoding == "protobuf":
        return _protobuf(topic.type, topic.schema_encoding, topic.schema)
    if topic.encoding == "json":
        return _json
    raise UndecodableError(f"encoding {topic.encoding!r}, which is not known")


@lru_cache(maxsize=64)
def _ros(encoding: str, kind: str, schema_encoding: str, schema: bytes) -> Decoder:
    """By the definition in the bag; the standard one where the bag has none, or a damaged one."""
    from rosbags.serde import SerdeError  # noqa: PLC0415 - heavy
    from rosbags.typesys.msg import normalize_msgtype  # noqa: PLC0415 - heavy

    name = normalize_msgtype(kind)
    store = _store(name, schema_encoding, schema) or _standard(name, encoding)
    decode = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr

    def ros(data: Raw) -> Any:
        try:
            return decode(data, name)
        except (SerdeError, struct.error, ValueError, IndexError, KeyError, OverflowError, MemoryError) as error:
            raise UndecodableError(str(error)) from error

    return ros


def _store(name: str, schema_encoding: str, schema: bytes) -> Any:
    """A type store with the bag's own definitions; None where they define nothing usable."""
    from rosbags.typesys import (  # noqa: PLC0415 - heavy
        Stores,
        TypesysError,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    store = get_typestore(Stores.EMPTY)
    try:
        text = schema.decode()
        if schema_encoding == "ros2idl":
            types: dict[str, Any] = {}
            if text.startswith(f"{_IDL_SEPARATOR}IDL: "):
                for definition in text.split(_IDL_SEPARATOR)[1:]:
                    types.update(get_types_from_idl(definition.partition("\n")[2]))
            else:
                types.update(get_types_from_idl(text))
        elif schema_encoding in {"ros1msg", "ros2msg"} and text:
            types = get_types_from_msg(text, name)
        else:
            return None
        store.register(types)
        store.get_msgdef(name)
    # The parser, and the code that it generates and compiles, fail in all these ways on damaged definitions.
    except (
        TypesysError, ValueError, LookupError, SyntaxError, NameError, AttributeError, TypeError, AssertionError,
        RecursionError, OverflowError, MemoryError,
    ):  # fmt: skip
        return None
    return store


def _standard(name: str, encoding: str) -> Any:
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - heavy

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.LATEST)
    if name not in store.fielddefs:
        raise UndecodableError(f"type {name!r} without a definition")
    return store


@lru_cache(maxsize=64)
def _protobuf(kind: str, schema_encoding: str, schema: bytes) -> Decoder:
    from google.protobuf.message import DecodeError  # noqa: PLC0415 - heavy
    from mcap.exceptions import McapError  # noqa: PLC0415 - heavy
    from mcap.records import Schema  # noqa: PLC0415 - heavy
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415 - heavy

    try:
        found = DecoderFactory().decoder_for("protobuf", Schema(1, schema, schema_encoding, kind))
    except (McapError, DecodeError, TypeError, KeyError, ValueError, RecursionError) as error:
        raise UndecodableError(f"schema {kind!r}: {_first_line(error)}") from error
    if found is None:
        raise UndecodableError(f"schema encoding {schema_encoding!r} for protobuf messages")
    decode: Callable[[bytes], Any] = found

    def protobuf(data: Raw) -> Any:
        try:
            return decode(bytes(data))
        except (DecodeError, MemoryError) as error:
            raise UndecodableError(_first_line(error)) from error

    return protobuf


def _json(data: Raw) -> Any:
    try:
        return json.loads(bytes(data), object_hook=lambda found: SimpleNamespace(**found))
    except (ValueError, RecursionError) as error:
        raise UndecodableError(_first_line(error)) from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
