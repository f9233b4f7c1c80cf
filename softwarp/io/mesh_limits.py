"""What a mesh file declares, compared with the file before a foreign parser makes room for it."""

import base64
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from softwarp.meshing import MeshError

_HOLES = 2**24  # numbers of nodes may have holes; a file of any size may go so far
_UNPACKED = 2**26  # bytes that a packed file of any size may unpack to
_RATIO = 100  # of unpacked to packed, above that
_COUNTS = {  # lines of numbers that count something
    ".vtk": rb"^(?:POINTS|CELLS|CELL_TYPES|POINT_DATA|CELL_DATA|LOOKUP_TABLE|COLOR_SCALARS|FIELD|DIMENSIONS) [^\n]*",
    ".vtu": rb"NumberOf(?:Points|Cells)=[\"'][^\"']*",
    ".msh": rb"^\$(?:Nodes|Elements|Entities|PhysicalNames|Periodic|NodeData|ElementData)[ \t\r]*\n[0-9 \t]*",
}
_NODE_LINES = rb"^\$Nodes[ \t\r]*\n.*?^\$EndNodes"


def check_declared(path: Path) -> None:
    """Refuse a mesh file that announces more than it can hold, or unpacks to far more than it is.

    Raises:
        MeshError: If it does; the message tells what is declared and how large the file is.
    """
    suffix, content = path.suffix.lower(), path.read_bytes()
    if suffix not in _COUNTS:
        return
    kind = re.search(rb"^DATASET[ \t]+(\w+)", content, flags=re.MULTILINE | re.IGNORECASE)
    if suffix == ".vtk" and kind is not None and kind.group(1).upper() != b"UNSTRUCTURED_GRID":
        raise MeshError(f"mesh {path.name!r} is a {kind.group(1).decode()}; only unstructured grids can be read")
    counts = [int(n) for line in re.findall(_COUNTS[suffix], content, flags=re.MULTILINE) for n in _numbers(line)]
    if suffix == ".msh" and b"\0" not in content:  # text: also the numbers of nodes
        nodes = re.search(_NODE_LINES, content, flags=re.MULTILINE | re.DOTALL)
        counts += [int(n) for n in _numbers(nodes.group())] if nodes else []
    most = max(counts, default=0)
    if most > max(len(content), _HOLES):
        raise MeshError(
            f"mesh {path.name!r} declares {most} items, the file has {len(content)} bytes; it is cut short or altered, "
            "write or download it again"
        )
    if suffix == ".vtu" and b"vtkZLibDataCompressor" in content:
        _check_packed(path.name, content)


def _numbers(line: bytes) -> list[bytes]:
    """Whole numbers of a line that stand alone."""
    return re.findall(rb"(?<![\w.+-])\d+(?![\w.])", line)


def _check_packed(name: str, content: bytes) -> None:
    """Unpack every block of a .vtu file, a part at a time, and count."""
    limit, total = max(_UNPACKED, _RATIO * len(content)), 0
    for block in _blocks(content):
        stream = zlib.decompressobj()
        while block and not stream.eof:
            try:
                total += len(stream.decompress(block, 2**20))
            except zlib.error:  # the parser will say so
                break
            block = stream.unconsumed_tail
            if total > limit:
                raise MeshError(f"mesh {name!r} unpacks to more than {limit} bytes; write it again unpacked")


def _blocks(content: bytes) -> Iterator[bytes]:
    """The packed blocks of the arrays of a .vtu file, inline or appended."""
    width = 8 if b'header_type="UInt64"' in content else 4
    order: Literal["big", "little"] = "big" if b'byte_order="BigEndian"' in content else "little"
    appended = re.search(rb"<AppendedData[^>]*encoding=\"(raw|base64)\"[^>]*>\s*_", content)
    for array in re.finditer(rb"<DataArray([^>]*)>([^<]*)", content):
        offset = re.search(rb"offset=\"(\d+)\"", array.group(1))
        is_raw = offset is not None and appended is not None and appended.group(1) == b"raw"
        if offset is not None and appended is not None:
            data = content[appended.end() + int(offset.group(1)) :]
        else:
            data = array.group(2).strip()
        head = _decoded(data, width, is_raw)
        count = int.from_bytes(head, order)
        if count > len(content):
            continue
        size = width * (3 + count)
        header = _decoded(data, size, is_raw)
        sizes = [int.from_bytes(header[at : at + width], order) for at in range(3 * width, size, width)]
        body = data[size if is_raw else 4 * -(-size // 3) :]
        packed = _decoded(body, sum(sizes), is_raw)
        at = 0
        for length in sizes:
            yield packed[at : at + length]
            at += length


def _decoded(data: bytes, length: int, is_raw: bool) -> bytes:
    """The first bytes of a payload that is raw or base64."""
    if is_raw:
        return data[:length]
    try:
        return base64.b64decode(data[: 4 * -(-length // 3)])[:length]
    except ValueError:
        return b""
