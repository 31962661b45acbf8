"""XMP packets: DJI's tags, as attributes or as elements, whatever prefix is bound to the namespace."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING
from xml.etree.ElementTree import ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from pipeline.engine.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from xml.etree.ElementTree import Element

# As DJI writes it; some firmware drops the last slash or the version.
_DJI_NAMESPACE = "dji.com/drone-dji"
_XMP_NAMESPACE = "http://ns.adobe.com/xap/1.0/"
_MAX_BYTES = 4 << 20


@dataclass(frozen=True, slots=True)
class Xmp:
    """What a packet says of the drone and of the programs that wrote the file.

    Args:
        dji: Tag name without prefix to its text, in DJI's namespace.
        creator_tool: xmp:CreatorTool, empty where absent.
    """

    dji: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    creator_tool: str = ""


def read_xmp(packet: bytes) -> Xmp:
    """Reads an XMP packet.

    Args:
        packet: The packet's bytes as stored in the image.

    Returns:
        The tags; the first of several values of one tag wins.

    Raises:
        InputError: Not well-formed XML, or it declares entities (which can expand without bound).

    Source: ISO 16684-1 (XMP), 7: a property may be an attribute of rdf:Description or an element in it.
    """
    if len(packet) > _MAX_BYTES:
        raise _unreadable(f"{len(packet)} bytes", f"at most {_MAX_BYTES} bytes")
    try:
        root = fromstring(packet.strip(b"\x00 \t\r\n"), forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError, RecursionError) as error:
        raise _unreadable(str(error) or type(error).__name__, "well-formed XML without a DTD") from error
    dji: dict[str, str] = {}
    creator = ""
    for namespace, name, text in _properties(root):
        if _DJI_NAMESPACE in namespace:
            dji.setdefault(name, text.strip())
        elif namespace == _XMP_NAMESPACE and name == "CreatorTool":
            creator = creator or text.strip()
    return Xmp(MappingProxyType(dji), creator)


def _properties(root: Element) -> Iterator[tuple[str, str, str]]:
    for element in root.iter():
        if isinstance(element.tag, str) and element.text and not len(element):
            yield (*_split(element.tag), element.text)
        for name, text in element.attrib.items():
            yield (*_split(name), text)


def _split(tag: str) -> tuple[str, str]:
    namespace, _, name = tag.rpartition("}")
    return namespace.removeprefix("{"), name


def _unreadable(found: str, expected: str) -> InputError:
    return InputError("E-XMP-01", "the XMP packet cannot be read", found=found, expected=expected)
