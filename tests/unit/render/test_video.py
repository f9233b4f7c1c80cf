import builtins
import os

import numpy as np
import pytest
from PIL import Image

from softwarp.render import contact_sheet, write_png, write_video


def moving_square(count=12, height=48, width=64):
    """A red square that moves to the right over a grey ground."""
    frames = np.full((count, height, width, 3), 200, dtype=np.uint8)
    for k in range(count):
        frames[k, 10:20, 3 * k : 3 * k + 10] = (220, 30, 30)
    return frames


def read_mp4(path):
    import av

    with av.open(str(path)) as film:
        rate = film.streams.video[0].average_rate
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]), float(rate)


@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
def test_mp4_gives_the_frames_back(tmp_path, size):
    """As many frames, at their rate, near to their colours; odd sizes gain a repeated row and column."""
    frames = moving_square(12, *size)
    film, rate = read_mp4(write_video(tmp_path / "a.mp4", frames, fps=20))
    assert film.shape == (12, 48, 64, 3)
    assert rate == 20.0
    assert np.abs(film[:, : size[0], : size[1]].astype(int) - frames).mean() < 4.0
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_mp4_keeps_a_broken_rate(tmp_path):
    _, rate = read_mp4(write_video(tmp_path / "a.mp4", moving_square(), fps=12.5))
    assert rate == 12.5


def test_gif_gives_the_frames_back_in_time(tmp_path):
    """Rounded to hundredths of a second the film still lasts 12 / 30 s, and it loops."""
    frames = moving_square()
    film = Image.open(write_video(tmp_path / "a.gif", iter(frames), fps=30))
    assert film.n_frames == 12
    assert film.info["loop"] == 0
    total = 0
    for k in range(12):
        film.seek(k)
        total += film.info["duration"]
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - frames[k]).mean() < 4.0
    assert total == 400


def test_fast_gif_leaves_frames_out(tmp_path):
    """100 frames per second become 50; the duration stays."""
    film = Image.open(write_video(tmp_path / "a.gif", moving_square(), fps=100))
    assert film.n_frames == 6
    assert film.info["duration"] == 20


def test_png_is_exact(tmp_path):
    frame = moving_square(1)[0]
    np.testing.assert_array_equal(np.asarray(Image.open(write_png(tmp_path / "a.png", frame))), frame)


def test_contact_sheet_places_pictures_row_by_row():
    frames = np.arange(5, dtype=np.uint8)[:, None, None, None] * np.ones((5, 4, 6, 3), dtype=np.uint8)
    sheet = contact_sheet(frames, columns=3, gap=2)
    assert sheet.shape == (10, 22, 3)
    assert sheet[0, 0, 0] == 0
    assert sheet[0, 8, 0] == 1
    assert sheet[6, 0, 0] == 3
    assert sheet[6, 16, 0] == 255
    assert contact_sheet(frames).shape == (12, 26, 3)


def test_labels_are_written_into_their_picture():
    sheet = contact_sheet(moving_square(2, 60, 80), columns=2, labels=["", "t = 1 s"], gap=0)
    np.testing.assert_array_equal(sheet[:, :80], moving_square(1, 60, 80)[0])
    assert (sheet[:30, 80:].max(axis=-1) < 120).sum() > 10
    with pytest.raises(ValueError, match="2 pictures but 1 labels"):
        contact_sheet(moving_square(2), labels=["one"])


def test_bad_frames_are_refused_and_nothing_is_left(tmp_path):
    frames = moving_square(3)
    for bad, message in (
        (frames.astype(float), r"frame 0 must be uint8 .* got float64"),
        (frames[..., 0], r"frame 0 .* got uint8 of shape \(48, 64\)"),
        (frames[:0], "there are no frames"),
        ([frames[0], frames[0][:40]], r"frame 1 has shape \(40, 64, 3\), the first has \(48, 64, 3\)"),
    ):
        for name in ("a.mp4", "a.gif"):
            with pytest.raises(ValueError, match=message):
                write_video(tmp_path / name, bad, fps=10)
    with pytest.raises(ValueError, match=r"ends in \.mp4 or \.gif, got '\.avi'"):
        write_video(tmp_path / "a.avi", frames, fps=10)
    with pytest.raises(ValueError, match="fps must be positive"):
        write_video(tmp_path / "a.gif", frames, fps=0)
    with pytest.raises(ValueError, match=r"ends in \.png"):
        write_png(tmp_path / "a.jpg", frames[0])
    assert os.listdir(tmp_path) == []


def test_missing_codec_names_the_extra(tmp_path, monkeypatch):
    load = builtins.__import__

    def without_av(name, *args, **kwargs):
        if name == "av":
            raise ImportError(name)
        return load(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_av)
    with pytest.raises(ImportError, match=r"pip install 'softwarp\[video\]'"):
        write_video(tmp_path / "a.mp4", moving_square(), fps=10)
    assert os.listdir(tmp_path) == []
