"""Files that appear complete or not at all."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a scratch path to write to; it becomes ``path`` when the block ends without an exception.

    The scratch file stands beside ``path`` and keeps its suffix. Missing parent folders are made. An interrupted or
    failed block leaves what was at ``path`` before, and no scratch file.

    Args:
        path: The file to write.

    Yields:
        An empty file's path, to be overwritten.

    Raises:
        OSError: If the file cannot be made there; the message names the file and the reason.
    """
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(f"cannot write {target}: it is a folder; give a file name inside it")
    scratch = target.with_name(f".{target.stem}.{uuid.uuid4().hex[:12]}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch.touch(exist_ok=False)
    except OSError as error:
        reason = error.strerror or str(error)
        raise type(error)(
            error.errno, f"cannot write {target}: {reason}; choose a folder that exists or can be made and is writable"
        ) from error
    try:
        yield scratch
        os.replace(scratch, target)
    finally:
        scratch.unlink(missing_ok=True)
