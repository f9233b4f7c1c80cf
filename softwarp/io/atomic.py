"""Files that appear complete or not at all, and one sentence for whatever keeps them from being written.

A writer fills a scratch file beside its target, forces it to disk and renames it. Meanwhile it holds a shared lock on
the folder, which ends with its process however that ends; so the next writer of the same file can tell scratch files
that a killed process left from those that are being written, and deletes them.
"""

import errno
import fcntl
import glob
import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

_TOKEN = 12  # hexadecimal digits that tell scratch files of one target apart
_PROBE = 1 << 20  # bytes written to find out why a library could not write
_ELSEWHERE = "choose a folder on another disk"
_REASONS = {  # errors of a disk or folder: what is wrong, and the way out
    errno.ENOSPC: ("the disk is full", f"free space on it or {_ELSEWHERE}"),
    errno.EDQUOT: ("your quota of this disk is used up", f"delete files of yours or {_ELSEWHERE}"),
    errno.EROFS: ("its file system is read-only", f"{_ELSEWHERE} or mount it for writing"),
    errno.EIO: ("the disk reports an input/output error", f"check it and its connection, or {_ELSEWHERE}"),
    errno.EFBIG: ("the file would exceed the largest size allowed", f"raise the limit (ulimit -f) or {_ELSEWHERE}"),
    errno.EACCES: ("permission denied", "choose a folder that you may write to"),
    errno.EPERM: ("operation not permitted", "choose a folder that you may write to"),
    errno.ENOTDIR: ("a part of its path is a file", "choose a folder that exists or can be made"),
    errno.EEXIST: ("a part of its path is a file", "choose a folder that exists or can be made"),
    errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
    errno.EMFILE: ("too many files are open", "close some or raise the limit (ulimit -n)"),
    errno.ENFILE: ("too many files are open on this machine", "close some"),
}
DISK_ERRORS = frozenset(_REASONS)


class WriteError(OSError):
    """A file that could not be written; the message names the file, the reason and the way out.

    What stood in its place before is as it was.
    """

    @classmethod
    def of(cls, target: Path, cause: OSError) -> Self:
        """The error for a file and what the system said."""
        default = (cause.strerror or str(cause), "choose a folder that exists or can be made and is writable")
        reason, way_out = _REASONS.get(cause.errno or 0, default)
        kept = " (the old file is kept)" if target.is_file() else ""
        return cls(cause.errno, f"cannot write {target}: {reason}{kept}; {way_out}")

    def and_then(self, advice: str) -> Self:
        """The same error with a further sentence for the reader."""
        return type(self)(self.errno, f"{self}; {advice}")

    def __str__(self) -> str:
        return str(self.args[-1])


@contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[None]:
    """Within the block, what the disk refuses about ``path`` or a folder above it becomes one clear error.

    Libraries that hide why they could not write are seen through by writing some bytes beside ``path``.

    Args:
        path: The file that is written in the block.

    Raises:
        WriteError: If it cannot be written.
    """
    target = Path(path)
    try:
        yield
    except WriteError:
        raise
    except (OSError, RuntimeError) as error:  # foreign writers raise either
        told = isinstance(error, OSError) and error.errno is not None
        cause = error if told else _trouble(target.parent)
        if isinstance(cause, OSError) and (not told or _concerns(cause, target)):
            raise WriteError.of(target, cause) from error
        raise


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a scratch path to write to; it becomes ``path`` when the block ends without an exception.

    The scratch file stands beside ``path`` and keeps its suffix. Missing parent folders are made. An interrupted or
    failed block leaves what was at ``path`` before, and no scratch file; one that a killed process left is deleted.

    Args:
        path: The file to write.

    Yields:
        An empty file's path, to be overwritten.

    Raises:
        WriteError: If the file cannot be written there, be it at the start, in the block or at its end.
    """
    target = Path(path)
    with writing(target), _scratch_of(target) as scratch, writing(target):  # the inner one while the disk is still full
        yield scratch
        with scratch.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(scratch, target)
        _sync_folder(target.parent)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all.

    Raises:
        WriteError: If the file cannot be written there.
    """
    with atomic_path(path) as scratch:
        scratch.write_text(text, encoding="utf-8")


def prove_writable(path: str | os.PathLike[str]) -> None:
    """Make sure, before the work whose result goes to ``path``, that it can be written there; nothing is left.

    Raises:
        WriteError: If it cannot.
    """
    with writing(path), _scratch_of(Path(path)):
        pass


@contextmanager
def _scratch_of(target: Path) -> Iterator[Path]:
    """An empty file beside ``target`` that is gone after the block."""
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {target}: it is a folder; give a file name inside it")
    scratch = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:_TOKEN]}{target.suffix}")
    target.parent.mkdir(parents=True, exist_ok=True)
    with _at_work(target):
        try:
            scratch.touch(exist_ok=False)
            yield scratch
        finally:
            for left in target.parent.glob(f"{glob.escape(scratch.stem)}*"):  # a library may have made more of them
                left.unlink(missing_ok=True)


@contextmanager
def _at_work(target: Path) -> Iterator[None]:
    """Tell other writers that scratch files are being written in the folder; if nobody else is at it, clean first."""
    try:
        folder = os.open(target.parent, os.O_RDONLY)
    except OSError:  # a folder may be written to and not read; then nobody cleans
        yield
        return
    try:
        with suppress(OSError):  # another writer is at work, or a file system without locks
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _sweep(target)
        with suppress(OSError):
            fcntl.flock(folder, fcntl.LOCK_SH)
        yield
    finally:
        os.close(folder)


def _sweep(target: Path) -> None:
    """Delete the scratch files of ``target`` that killed writers left."""
    scratch = re.compile(rf"\.({re.escape(target.stem)}|probe)\.[0-9a-f]{{{_TOKEN}}}(\..*)?")
    for left in target.parent.iterdir():
        if scratch.fullmatch(left.name):
            left.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Force a rename to disk, where the file system knows how to."""
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _concerns(error: OSError, target: Path) -> bool:
    """Whether an error is about writing ``target``: its scratch file, a folder above it, or the disk."""
    if error.filename is None:
        return error.errno in _REASONS
    name = Path(os.fsdecode(error.filename)) if not isinstance(error.filename, int) else target
    return name == target or name in target.parents or name.name.startswith(f".{target.stem}.")


def _trouble(folder: Path) -> OSError | None:
    """What the system says to a file written into ``folder``; None if it lets it pass."""
    probe = folder / f".probe.{uuid.uuid4().hex[:_TOKEN]}"
    try:
        with probe.open("wb") as file:
            file.write(bytes(_PROBE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return None
