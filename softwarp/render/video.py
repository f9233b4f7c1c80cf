"""Frames to files: MP4, GIF and PNG, and several frames laid out in one picture."""

import os
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.io.atomic import atomic_path

Frame = NDArray[np.uint8]

_GIF_MAX_FPS = 50.0  # browsers slow down anything faster
_QUALITY = "18"  # x264 constant rate factor: visually lossless


def write_video(path: str | os.PathLike[str], frames: Iterable[ArrayLike], fps: float) -> Path:
    """Write frames as a film, whole or not at all.

    Args:
        path: File to write, ``.mp4`` (H.264; an odd width or height is padded by a pixel) or ``.gif``.
        frames: Pictures of one size, each (height, width, 3) uint8; an array (n, height, width, 3) or any iterable.
        fps: Frames per second; a GIF above 50 leaves frames out and keeps its duration.

    Returns:
        The path written.

    Raises:
        ImportError: If a package is missing; the message names the extra to install.
        ValueError: For another suffix, no frames, or a frame of another shape or type.
        OSError: If the file cannot be written there.
    """
    target = Path(path)
    if target.suffix not in (".mp4", ".gif"):
        raise ValueError(f"cannot write {target}: a film ends in .mp4 or .gif, got {target.suffix!r}")
    if not (np.isfinite(fps) and fps > 0.0):
        raise ValueError(f"cannot write {target}: fps must be positive, got {fps:g}")
    write = _write_mp4 if target.suffix == ".mp4" else _write_gif
    with atomic_path(target) as scratch:
        write(scratch, _checked(target, frames), float(fps))
    return target


def write_png(path: str | os.PathLike[str], frame: ArrayLike) -> Path:
    """Write one picture, (height, width, 3) uint8, as a PNG file, whole or not at all; returns its path."""
    target = Path(path)
    if target.suffix != ".png":
        raise ValueError(f"cannot write {target}: a picture ends in .png, got {target.suffix!r}")
    picture = next(_checked(target, [frame]))
    image = _pillow()
    with atomic_path(target) as scratch:
        image.fromarray(picture).save(scratch, optimize=True)
    return target


def contact_sheet(
    frames: Sequence[ArrayLike] | NDArray[np.uint8],
    columns: int | None = None,
    labels: Sequence[str] | None = None,
    *,
    gap: int = 4,
) -> Frame:
    """Lay pictures of one size out in rows, first to last.

    Args:
        frames: Pictures, shape (n, height, width, 3).
        columns: Pictures in a row; None makes the sheet near to square.
        labels: A short text for each picture, written into its upper left corner.
        gap: White pixels between pictures.

    Returns:
        The sheet, shape (height, width, 3).
    """
    pictures = list(_checked(Path("contact sheet"), frames))
    if labels is not None and len(labels) != len(pictures):
        raise ValueError(f"contact sheet: {len(pictures)} pictures but {len(labels)} labels")
    columns = int(np.ceil(np.sqrt(len(pictures)))) if columns is None else columns
    if columns < 1:
        raise ValueError(f"contact sheet: columns must be at least 1, got {columns}")
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    height, width = pictures[0].shape[:2]
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for k, picture in enumerate(pictures):
        y, x = (k // columns) * (height + gap), (k % columns) * (width + gap)
        sheet[y : y + height, x : x + width] = picture if labels is None else _labelled(picture, labels[k])
    return sheet


def _labelled(picture: Frame, text: str) -> Frame:
    """A copy of a picture with text in its upper left corner."""
    from PIL import ImageDraw, ImageFont

    image = _pillow().fromarray(picture)
    size = max(10.0, picture.shape[0] / 18.0)
    ImageDraw.Draw(image).text((0.7 * size, 0.5 * size), text, fill=(45, 50, 60), font=ImageFont.load_default(size))
    return np.asarray(image)


def _checked(target: Path, frames: Iterable[ArrayLike]) -> Iterator[Frame]:
    """The frames one by one, each of the first one's shape; at least one."""
    shape: tuple[int, ...] | None = None
    for number, frame in enumerate(frames):
        picture = np.asarray(frame)
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape:
            raise ValueError(
                f"{target}: frame {number} must be uint8 of shape (height, width, 3), "
                f"got {picture.dtype} of shape {picture.shape}"
            )
        shape = shape or picture.shape
        if picture.shape != shape:
            raise ValueError(f"{target}: frame {number} has shape {picture.shape}, the first has {shape}")
        yield np.ascontiguousarray(picture)
    if shape is None:
        raise ValueError(f"{target}: there are no frames; give at least one")


def _write_mp4(path: Path, frames: Iterator[Frame], fps: float) -> None:
    try:
        import av
    except ImportError as error:
        raise ImportError(
            "writing .mp4 needs the package av, which is not installed; pip install 'softwarp[video]', or write a .gif"
        ) from error
    first = next(frames)
    height, width = first.shape[:2]
    even = (height + height % 2, width + width % 2)
    with av.open(str(path), mode="w", options={"movflags": "+faststart"}) as film:
        stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(10000))
        stream.height, stream.width = even
        stream.pix_fmt = "yuv420p"  # the one that every player shows
        stream.options = {"crf": _QUALITY, "preset": "medium"}
        for frame in (f for part in ([first], frames) for f in part):
            padded = np.pad(frame, ((0, even[0] - height), (0, even[1] - width), (0, 0)), mode="edge")
            film.mux(stream.encode(av.VideoFrame.from_ndarray(padded, format="rgb24")))
        film.mux(stream.encode())


def _write_gif(path: Path, frames: Iterator[Frame], fps: float) -> None:
    """A looping GIF with one palette for all frames, so that still parts do not flicker."""
    image = _pillow()
    pictures = list(frames)
    if fps > _GIF_MAX_FPS:
        ticks = np.arange(0.0, len(pictures) / fps, 1.0 / _GIF_MAX_FPS)
        pictures = [pictures[min(round(t * fps), len(pictures) - 1)] for t in ticks]
        fps = _GIF_MAX_FPS
    palette = _palette(pictures)
    indexed = [image.fromarray(p).quantize(palette=palette, dither=image.Dither.FLOYDSTEINBERG) for p in pictures]
    # A GIF counts in hundredths of a second: round the frame borders, not the durations, so that errors do not add up.
    borders = np.round(np.arange(len(indexed) + 1) * 100.0 / fps).astype(int) * 10
    durations = [int(d) for d in np.diff(borders)]
    indexed[0].save(path, save_all=True, append_images=indexed[1:], duration=durations, loop=0, disposal=1)


def _palette(pictures: list[Frame]) -> Any:
    """A paletted image whose 256 colours suit all pictures.

    A colour counts with the square root of its area: by area alone a plain background takes most of the entries, and
    counting all alike leaves it too few.
    """
    image = _pillow()
    some = np.concatenate([p.reshape(-1, 3) for p in pictures[:: -(-len(pictures) // 16)]])
    _, first, count = np.unique(some >> 2, axis=0, return_index=True, return_counts=True)
    weighted = np.repeat(some[first], np.ceil(np.sqrt(count)).astype(int), axis=0)
    return image.fromarray(weighted[None]).quantize(256, dither=image.Dither.NONE)


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(
            "pictures need the package pillow, which is not installed; pip install 'softwarp[video]'"
        ) from error
    return Image
