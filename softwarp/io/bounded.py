"""Reading files of strangers: what a file says of its sizes is compared with the file before memory is taken for it.

Everything that is not what it should be ends in one error, ``DamagedFileError``, whatever library met it.
"""

from __future__ import annotations

import io
import json
import math
import pickletools
import struct
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from softwarp.host import free_memory

if TYPE_CHECKING:
    from torch import Tensor

DEFLATE_RATIO = 1032  # bytes that deflate makes of one, at most
_SLACK = 1024  # bytes of a packed member's own overhead
_GLOBALS = {  # names that our own tensors, numbers and text need in a pickle
    "collections OrderedDict",
    "torch Size",
    "torch device",
    "torch._utils _rebuild_parameter",
    "torch._utils _rebuild_tensor_v2",
}
_BROKEN = (  # of zipfile, zlib, numpy, json and pickletools at damaged content
    *(ValueError, LookupError, ArithmeticError, EOFError, OSError, RuntimeError, TypeError, AttributeError),
    *(SyntaxError, MemoryError, zipfile.BadZipFile, zlib.error, struct.error),  # the first two of nested headers
)


class DamagedFileError(ValueError):
    """A file that does not hold what it should, and why."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Every array of an ``.npz`` file.

    Raises:
        DamagedFileError: If it is no such file, or one is cut short, altered, larger than the file or memory can hold,
            or made of Python objects.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = _check_members(archive, path.stat().st_size)
            return {member.filename.removesuffix(".npy"): _read_array(archive, member) for member in members}
    except DamagedFileError:
        raise
    except _BROKEN as error:
        raise DamagedFileError(_told(error)) from error


def read_tensors(source: Path | bytes, *, device: str = "cpu") -> Any:
    """What ``torch.save`` wrote: tensors, numbers and text; no code of it is run.

    Args:
        source: File, or its content.
        device: Where the tensors go.

    Raises:
        DamagedFileError: If it is cut short, altered, larger than the file can hold, or holds anything else.
    """
    import torch

    size = len(source) if isinstance(source, bytes) else source.stat().st_size
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else source) as archive:
            members = _check_members(archive, size)
            if all(member.filename.endswith(".npy") for member in members):
                raise DamagedFileError("an .npz file of arrays, as recordings and demonstrations are, no checkpoint")
            for member in members:
                if member.compress_type != zipfile.ZIP_STORED:
                    raise DamagedFileError(f"{member.filename} is packed, which softwarp never does")
                if member.filename.endswith(".pkl"):
                    _check_pickle(archive.read(member))
            broken = archive.testzip()  # reads all of it and compares checksums
    except DamagedFileError:
        raise
    except _BROKEN as error:
        raise DamagedFileError(f"cut short or not a checkpoint ({_told(error)})") from error
    if broken is not None:
        raise DamagedFileError(f"damaged in {broken}")
    try:
        opened = io.BytesIO(source) if isinstance(source, bytes) else source
        content = torch.load(opened, map_location=device, weights_only=True)
    except Exception as error:  # torch raises several kinds, all meaning: not a file of ours
        raise DamagedFileError(f"not written by softwarp ({type(error).__name__})") from error
    for tensor in _tensors(content):
        if tensor.numel() * tensor.element_size() > size:
            raise DamagedFileError(f"a tensor of shape {tuple(tensor.shape)} is larger than the file")
    return content


def parse_json(text: str | bytes) -> Any:
    """JSON without numbers that it does not know.

    Raises:
        DamagedFileError: If it is none, or nested too deeply.
    """
    try:
        return json.loads(text)
    except _BROKEN as error:
        raise DamagedFileError(_told(error)) from error


def unpack(data: bytes, limit: int) -> bytes:
    """What ``zlib.compress`` packed, at most ``limit`` bytes.

    Raises:
        DamagedFileError: If it is damaged or larger.
    """
    packed = zlib.decompressobj()
    try:
        content = packed.decompress(data, limit)
        if packed.unconsumed_tail or (len(content) == limit and packed.decompress(packed.unconsumed_tail, 1)):
            raise DamagedFileError(f"packed content is larger than {limit / 2**20:.0f} MiB")
        if not packed.eof:
            raise DamagedFileError("packed content is cut short")
    except zlib.error as error:
        raise DamagedFileError(_told(error)) from error
    return content


def _check_members(archive: zipfile.ZipFile, size: int) -> list[zipfile.ZipInfo]:
    """The members of an archive, if their sizes fit the file and memory."""
    members = archive.infolist()
    if len({member.filename for member in members}) < len(members):
        raise DamagedFileError("two members have one name")
    for member in members:
        packed, unpacked = member.compress_size, member.file_size
        is_stored = member.compress_type == zipfile.ZIP_STORED
        most = packed if is_stored else DEFLATE_RATIO * packed + _SLACK
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 1:
            raise DamagedFileError(f"{member.filename} is packed in a way that softwarp never uses")
        if packed > size or unpacked > most:
            raise DamagedFileError(f"{member.filename} declares {_size(unpacked)}, the whole file has {_size(size)}")
    total, free = sum(member.file_size for member in members), free_memory()
    if total > free:
        raise DamagedFileError(f"unpacked it takes {_size(total)}, {_size(free)} of memory are free")
    return members


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """An array whose header says no more than its member holds."""
    with archive.open(member) as opened:
        stream: Any = opened  # which can also fill what is there
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise DamagedFileError(f"{member.filename} has npy version {version}")
        read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, is_fortran, dtype = read_header(stream)
        if dtype.hasobject:
            raise DamagedFileError(f"{member.filename} holds Python objects")
        if any(length < 0 for length in shape):
            raise DamagedFileError(f"{member.filename} has shape {shape}")
        declared, held = math.prod(shape) * dtype.itemsize, member.file_size - stream.tell()
        if declared != held:
            raise DamagedFileError(f"{member.filename} declares {_size(declared)} and holds {_size(held)}")
        array = np.empty(math.prod(shape), dtype)
        buffer, at = array.view(np.uint8).data if declared else memoryview(b""), 0
        while at < declared:
            count = stream.readinto(buffer[at:])  # compares the checksum with the last of it
            if not count:
                raise DamagedFileError(f"{member.filename} is cut short")
            at += count
    return array.reshape(shape, order="F" if is_fortran else "C")


def _check_pickle(data: bytes) -> None:
    """Refuse a pickle that names anything but what our own tensors, numbers and text need."""
    for opcode, argument, _ in pickletools.genops(data):
        if opcode.name in ("STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4"):
            raise DamagedFileError("not written by softwarp (names in its pickle)")
        if opcode.name == "GLOBAL":
            is_storage = str(argument).startswith("torch ") and str(argument).endswith("Storage")
            if argument not in _GLOBALS and not is_storage:
                raise DamagedFileError(f"not written by softwarp (its pickle names {argument})")


def _tensors(content: Any) -> list[Tensor]:
    """All tensors in nested dictionaries, lists and tuples."""
    import torch

    found: list[Tensor] = []
    seen: set[int] = set()
    waiting = [content]
    while waiting:
        value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            found.append(value)
        elif isinstance(value, dict):
            waiting.extend(value.values())
        elif isinstance(value, list | tuple):
            waiting.extend(value)
    return found


def _told(error: BaseException) -> str:
    """What an error says, in one short line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200].rstrip(": ")


def _size(count: int) -> str:
    """Bytes for a reader."""
    for unit, name in ((2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if count >= unit:
            return f"{count / unit:.3g} {name}"
    return f"{count} bytes"
