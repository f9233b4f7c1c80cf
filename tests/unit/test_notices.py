"""What is told while kernels are compiled, without a compiler, and while commands work."""

import logging
import multiprocessing
import os
import threading
import time
from types import SimpleNamespace

import pytest

from softwarp import compiling, notices
from softwarp.compiling import _Watch


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> _Watch:
    """One that tells soon."""
    monkeypatch.setattr(compiling, "QUIET_SECONDS", 0.2)
    monkeypatch.setattr(compiling, "LOOK", 0.02)
    monkeypatch.setattr(compiling, "PAUSE", 0.1)
    return _Watch()


def load(watch: _Watch, seconds: float, compiled: bool = True) -> None:
    """A module that is compiled for so long, or found in the cache."""
    watch.begin()
    time.sleep(seconds)
    watch.end(compiled)


def test_what_is_quick_or_cached_is_not_told(watch, capfd):
    """Neither many modules that are only loaded nor one that takes a moment."""
    with watch.group(20):
        for _ in range(20):
            load(watch, 0.02, compiled=False)
    load(watch, 0.05)
    time.sleep(0.3)
    assert capfd.readouterr().err == ""


def test_count_of_a_group(watch, capfd, monkeypatch):
    """Of five modules two come from the cache: three are to be compiled, and the last line counts those."""
    monkeypatch.setattr(compiling.notices.Line.__init__, "__defaults__", (0.0,))
    with watch.group(5):
        load(watch, 0.0, compiled=False)
        load(watch, 0.0, compiled=False)
        side_by_side = [threading.Thread(target=load, args=(watch, seconds)) for seconds in (0.3, 0.5, 0.7)]
        for thread in side_by_side:
            thread.start()
        for thread in side_by_side:
            thread.join()
    told = capfd.readouterr().err.splitlines()
    counts = [line.partition(",")[0] for line in told[:-1]]
    assert list(dict.fromkeys(counts)) == [f"compiling kernels: {done} of about 3" for done in range(3)]
    assert told[-1] == "compiled 3 files of kernels in 1 s"
    assert 0.6 < watch.spent() < 5.0


def test_modules_one_by_one_share_a_line(watch, capfd):
    """Without a terminal there is one line at the beginning and, after a pause, one at the end."""
    for _ in range(4):
        load(watch, 0.15)
    time.sleep(0.5)
    told = capfd.readouterr().err.splitlines()
    assert [line.split()[0] for line in told] == ["compiling", "compiled"]
    assert told[-1].startswith("compiled 4 files of kernels in ")


def test_an_unknown_number_is_not_counted_down_to(watch, capfd, monkeypatch):
    """Modules that are met on the way: the first, then how many are done and that there is another; never "0"."""
    monkeypatch.setattr(compiling.notices.Line.__init__, "__defaults__", (0.0,))
    for _ in range(3):
        load(watch, 0.3)
    time.sleep(0.3)
    *told, last = capfd.readouterr().err.splitlines()
    states = list(dict.fromkeys(line.removeprefix("compiling kernels: ").partition(" s (")[0][:-3] for line in told))
    assert states == ["the first file", "1 file done, one more", "2 files done, one more"]
    assert last.startswith("compiled 3 files of kernels in ")


def test_nothing_is_told_to_those_who_asked_for_silence(watch, capfd, monkeypatch):
    """The logger's level is read anew each time."""
    monkeypatch.setattr(notices.log, "level", logging.ERROR)
    notices.log._cache.clear()
    load(watch, 0.5)
    notices.log._cache.clear()
    assert capfd.readouterr().err == ""


def test_one_of_many_workers_tells(monkeypatch):
    """Processes that one parent has started compile the same; the first that takes long speaks for all."""
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: SimpleNamespace(pid=f"test-{time.monotonic_ns()}"))
    parent = multiprocessing.parent_process()
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: parent)
    first, second = _Watch(), _Watch()
    assert [first._may_tell(), second._may_tell(), first._may_tell()] == [True, False, True]
    assert first._place is not None
    first._place.close()
    assert second._may_tell()


def test_a_line_in_place(monkeypatch, capfd):
    """On a terminal a line is renewed, cut to its width, and cleared or ended by a last one."""
    monkeypatch.setattr(notices, "_is_terminal", lambda: True)
    monkeypatch.setattr(notices, "RENEW_SECONDS", 0.0)
    monkeypatch.setenv("COLUMNS", "11")
    line = notices.Line()
    line.show("one")
    line.show("two, which is long")
    line.clear()
    line.end("three")
    line.end()
    assert capfd.readouterr().err == "\r\x1b[Kone\r\x1b[Ktwo, which\r\x1b[K\r\x1b[Kthree\n"


def test_progress_of_commands(monkeypatch, capfd):
    """Only commands tell it, only of what takes long, and a part that tells for itself is left alone."""
    monkeypatch.setattr(notices, "_is_terminal", lambda: True)
    monkeypatch.setattr(notices, "WAIT_SECONDS", 0.1)
    monkeypatch.setattr(notices, "RENEW_SECONDS", 0.0)

    def work() -> str:
        for step in range(3):
            notices.progress("walking", f"{step} of 3")
            time.sleep(0.08)
        notices.progress_ends()
        return capfd.readouterr().err

    assert work() == ""
    with notices.telling():
        assert work() == "\r\x1b[Kwalking: 2 of 3, 0 s\r\x1b[K"
        with notices.telling(False):
            assert work() == ""
        notices.progress("flying", "0 of 3")
    assert capfd.readouterr().err == ""
    assert work() == ""


def test_machines_without_a_gpu_are_not_told_so(capfd, caplog):
    """Lines of Warp's native code that only say that there is no GPU go; whatever else is written meanwhile stays."""
    caplog.set_level(logging.WARNING, logger="softwarp")
    with compiling.without_driver_line():
        os.write(2, b"before\nWarp CUDA error 100: no CUDA-capable device is detected (in function init)\n")
        os.write(
            2, b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. No GPU.\nWarp CUDA error 999: x\n"
        )
    assert capfd.readouterr().err == "before\nWarp CUDA error 999: x\n"


def test_work_without_steps_is_told(monkeypatch, capfd):
    """Of commands, if it takes long; errors pass, and no thread is left."""
    monkeypatch.setattr(notices, "_is_terminal", lambda: True)
    monkeypatch.setattr(notices, "WAIT_SECONDS", 0.1)
    with notices.working("building"):
        time.sleep(0.2)
    with notices.telling(), notices.working("building"):
        pass
    assert capfd.readouterr().err == ""
    with pytest.raises(ValueError, match="bad mesh"), notices.telling(), notices.working("building"):
        time.sleep(0.3)
        raise ValueError("bad mesh")
    told = capfd.readouterr().err
    assert told.startswith("\r\x1b[Kbuilding: 0 s") and told.endswith("\r\x1b[K")
    assert "softwarp-working" not in {thread.name for thread in threading.enumerate()}
    other = notices.Line()
    other.show("compiling")
    with notices.telling(), notices.working("building"):
        time.sleep(0.2)
    other.end()
    assert "building" not in capfd.readouterr().err
    with notices.telling(), notices.working("building"):
        time.sleep(0.2)
    assert "building" in capfd.readouterr().err
