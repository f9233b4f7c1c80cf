"""Whatever keeps a file from being written ends in one sentence; what stood there stays, and nothing else is left."""

import errno
import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments import eval as evaluation
from experiments.baselines_report import write_report
from experiments.train import way_on
from softwarp import cli
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.io.atomic import WriteError, atomic_path, prove_writable, write_text
from softwarp.io.usd import export_usd
from softwarp.planning import picture, plans
from softwarp.render import write_png, write_video
from softwarp.snapshot import Snapshot
from softwarp.training import checkpoints
from softwarp.training.curve import draw_learning_curve
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.logs import CsvTable, EventFile, LoggerConfig, ProgressLine, RunLog, read_csv
from tests.contract.test_resume import assert_equal, run
from tests.unit.experiments.test_baselines import write_run
from tests.unit.io.fakes import recording

DATA = Path(__file__).parents[1] / "data" / "before_the_move"
ROOM = 4096  # bytes that a process may write to a file where its limit stands for a full disk
STEPS = 2000

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small disk needs root")


def noise(*shape: int) -> torch.Tensor:
    """Numbers that do not pack."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def demonstrations() -> Demonstrations:
    ends = torch.zeros(1)
    steps = (noise(STEPS, 8), noise(STEPS, 2), torch.zeros(STEPS, dtype=torch.int64))
    return Demonstrations(*steps, ends, ends > 0.0, ends, env={"name": "CartStem"})


def snapshot() -> Snapshot:
    return Snapshot("scene", "float32", {"state.node_x": noise(1, STEPS, 3)})


def plan() -> plans.Plan:
    made = plans.Plan.load(DATA / "plan_tree.json")
    made.start = EnvSnapshot("CartStem", snapshot(), {"step_count": torch.zeros(1)})
    return made


def film(path: Path) -> None:
    write_video(path, (255 * noise(4, 48, 64, 3)).to(torch.uint8).numpy(), 10.0)


# A writer of every format, given the path to write.
WRITERS = {
    "text.json": lambda path: write_text(path, "a line\n" * STEPS),
    "eval.json": lambda path: evaluation.write(
        {"policies": {"none": {"return": 0.0, "success": 0.0, "failed": 0.0}}, "env": ["x"] * STEPS}, str(path)
    ),
    "step.pt": lambda path: checkpoints.save(path, "training", {"x": noise(STEPS)}),
    "snapshot.npz": lambda path: snapshot().save(path),
    "demonstrations.npz": lambda path: demonstrations().save(path),
    "trajectory.npz": lambda path: recording(40).save(path),
    "scene.usdc": lambda path: export_usd(recording(40), path),
    "scene.usda": lambda path: export_usd(recording(40), path),
    "scene.usdz": lambda path: export_usd(recording(40), path),
    "film.mp4": film,
    "film.gif": film,
    "picture.png": lambda path: write_png(path, (255 * noise(96, 128, 3)).to(torch.uint8).numpy()),
    "plan.json": lambda path: plan().save(path),
    "plan.png": lambda path: picture.draw(plans.Plan.load(DATA / "plan_tree.json"), path),
    "curve.png": lambda path: draw_learning_curve(DATA / "ppo", path),
    "table.csv": lambda path: CsvTable(path, [f"column_{k}" for k in range(STEPS)]),
    "events": lambda path: [EventFile(path, None).add({f"curve_{k}": 1.0}, k) for k in range(1)],
}
WHOLE = [name for name in WRITERS if name not in ("table.csv", "events")]


@contextmanager
def small_file_limit(size: int):
    """No file of this process may grow beyond ``size`` bytes: a true error of writing, without root."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def small_disk(folder: Path, *, is_full: bool):
    """A disk of 64 KiB at ``folder`` with one old file, full or read-only."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)], check=True)
    try:
        (folder / "old").write_text("old")
        if is_full:
            fill(folder)
        else:
            subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder: Path) -> None:
    """Leave no byte on the disk of a folder."""
    with (folder / "filling").open("wb", buffering=0) as file, pytest.raises(OSError, match="No space left"):
        while file.write(bytes(4096)):
            pass


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", WHOLE)
def test_file_that_cannot_grow(name, tmp_path):
    """Every writer, stopped in the midst of its file: the sentence, the old file, and no scratch file."""
    target = tmp_path / name
    target.write_bytes(b"old")
    with small_file_limit(ROOM), pytest.raises(WriteError, match=r"cannot write .*largest size.*old file is kept.*; "):
        WRITERS[name](target)
    assert contents(tmp_path) == {name: b"old"}
    WRITERS[name](target)  # and goes through without the limit
    assert target.stat().st_size > ROOM
    assert os.listdir(tmp_path) == [name]


@needs_root
@pytest.mark.parametrize("name", WRITERS)
def test_full_disk(name, tmp_path):
    """On a disk without a free byte."""
    disk = tmp_path / "disk"
    with small_disk(disk, is_full=True):
        before = contents(disk)
        with pytest.raises(WriteError, match=rf"cannot write {disk}/{name}.*the disk is full.*; free space on it or"):
            WRITERS[name](disk / name)
        left = contents(disk)
        left.pop(next((entry for entry in left if entry.startswith("events/")), ""), None)
        assert left == before


@needs_root
@pytest.mark.parametrize("name", WRITERS)
def test_read_only_disk(name, tmp_path):
    """A file system that is mounted for reading alone."""
    disk = tmp_path / "disk"
    with small_disk(disk, is_full=False):
        with pytest.raises(WriteError, match=rf"cannot write {disk}/{name}.*read-only; choose a folder on another"):
            WRITERS[name](disk / name)
        assert contents(disk) == {"old": b"old"}


CODES = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "your quota of this disk is used up",
    errno.EROFS: "its file system is read-only",
    errno.EIO: "the disk reports an input/output error",
    errno.EACCES: "permission denied",
}
STAGES = {"open": (Path, "touch"), "sync": (os, "fsync"), "rename": (os, "replace"), "write": (np, "savez")}


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_of_writing(code, stage, tmp_path, monkeypatch):
    """Making the file, filling it, forcing it to disk and renaming it may fail, each in five ways."""

    def fail(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    target = tmp_path / "state.npz"
    snapshot().save(target)
    before = contents(tmp_path)
    monkeypatch.setattr(*STAGES[stage], fail)
    with pytest.raises(WriteError, match=rf"cannot write {target}: {CODES[code]} \(the old file is kept\); ") as caught:
        snapshot().save(target)
    assert caught.value.errno == code
    assert contents(tmp_path) == before


def test_other_errors_stay_what_they_are(tmp_path):
    """A bug, or a file that is missing elsewhere, is not blamed on the disk."""
    for error in (RuntimeError("a bug"), FileNotFoundError(errno.ENOENT, "gone", "elsewhere.txt"), ValueError("x")):
        with pytest.raises(type(error)) as caught, atomic_path(tmp_path / "a.txt"):
            raise error
        assert caught.value is error
    assert os.listdir(tmp_path) == []
    with pytest.raises(IsADirectoryError, match="give a file name inside it"):
        prove_writable(tmp_path)


def test_scratch_of_killed_writers_goes(tmp_path):
    """The next run of the same writer deletes it, but not what another process is just writing, nor other files."""
    writer = """
import os, signal, sys
from softwarp.io.atomic import atomic_path
with atomic_path(sys.argv[1]) as scratch:
    scratch.write_text("half")
    print("writing", flush=True)
    sys.stdin.readline()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    target = tmp_path / "film.npz"
    kept = {".film.npz", "film.0123456789ab.npz", ".films.0123456789ab.npz", ".film.012345.npz"}
    for name in kept:
        (tmp_path / name).write_text("mine")
    run = [sys.executable, "-c", writer, str(target)]
    with subprocess.Popen(run, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "writing\n"
        write_text(target, "whole")
        (alive,) = set(os.listdir(tmp_path)) - kept - {target.name}
        process.communicate("\n")
    assert process.returncode == -signal.SIGKILL
    assert (tmp_path / alive).read_text() == "half"
    prove_writable(target)
    assert set(os.listdir(tmp_path)) == kept | {target.name}
    assert target.read_text() == "whole"


@needs_root
@pytest.mark.parametrize("moment", [pytest.param("progress", marks=pytest.mark.slow), "checkpoint"])
def test_training_on_a_disk_that_fills_up(moment, tmp_path, monkeypatch):
    """It ends with the sentence and how to go on, its last checkpoint is whole; with room again the bits are equal."""
    (tmp_path / "disk").mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "none", str(tmp_path / "disk")], check=True)
    folder = tmp_path / "disk" / "run"
    append, save = CsvTable.append, checkpoints.CheckpointFolder.save

    def fill_at(update: int) -> None:
        if update == 5:
            fill(folder.parent)

    def appended(table, row):
        fill_at(row["update"] if moment == "progress" else 0)
        append(table, row)

    def saved(folder, step, content):
        fill_at(content["counters"]["update"] if moment == "checkpoint" else 0)
        return save(folder, step, content)

    try:
        monkeypatch.setattr(CsvTable, "append", appended)
        monkeypatch.setattr(checkpoints.CheckpointFolder, "save", saved)
        with pytest.raises(WriteError, match=r"cannot write .*: the disk is full"):
            run(folder, 64 * 9)
        monkeypatch.undo()
        assert "the run is saved up to step 320, then go on with: softwarp train --resume" in way_on(folder)
        (folder.parent / "filling").unlink()
        content = checkpoints.CheckpointFolder(folder / "checkpoints", keep=1).load_latest()
        assert content["counters"]["update"] == 4
        assert_equal(run(folder, 64 * 9, resume=content), run(tmp_path / "whole", 64 * 9))
        told = [read_csv(place / "progress.csv") for place in (folder, tmp_path / "whole")]
        assert [row["update"] for row in told[0]] == [row["update"] for row in told[1]] == list(range(1, 9))
    finally:
        subprocess.run(["umount", "-l", str(folder.parent)], check=True)


def test_command_line_without_room_for_its_words(tmp_path, monkeypatch, capfd):
    """Results that cannot be printed are a failure; a remark that cannot be is not allowed to hide its cause."""
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert cli.main(["list"]) == 1
    assert capfd.readouterr().err.startswith("softwarp list: cannot write standard output: the disk is full; free ")
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        assert cli.main(["nonsense"]) == 2
        line = ProgressLine()
        line.note("10%")
        line.note("20%")  # a run goes on


def test_sweep_without_a_folder(tmp_path, capfd, monkeypatch):
    """Hydra makes the folders of a sweep; what keeps it from that is told as everywhere."""
    (tmp_path / "file").write_text("")
    folder = tmp_path / "file" / "sweep"
    for name, value in (("argv", []), ("stdout", sys.stdout)):
        monkeypatch.setattr(sys, name, value)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    assert cli.main(["train", "-m", "env=cart_stem", "seed=0,1", f"hydra.sweep.dir={folder}"]) == 1
    told = capfd.readouterr().err
    assert told.startswith(f"softwarp train: cannot write {folder}: a part of its path is a file; choose a folder ")
    assert told.count("\n") == 1


def test_table_is_not_torn_by_a_full_disk(tmp_path):
    """A row that does not go through leaves the rows before it, and the table goes on once there is room."""
    path = tmp_path / "t.csv"
    table = CsvTable(path, ("update", "a"))
    table.append({"update": 1, "a": 0.5})
    whole = path.read_bytes()
    with small_file_limit(len(whole) + 3), pytest.raises(WriteError, match=r"cannot write .*t\.csv: "):
        table.append({"update": 2, "a": 0.5})
    assert path.read_bytes() == whole
    table.append({"update": 2, "a": 0.5})
    assert path.read_bytes().startswith(whole)


def test_curves_are_read_by_tensorboard(tmp_path):
    """Points of two sessions, the later one hiding what it does again."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for resume, updates in ((None, (1, 2, 3)), (2, (3, 4))):
        log = RunLog(tmp_path, LoggerConfig(csv=False), [], resume_update=resume)
        for update in updates:
            log.add("progress", {"update": update, "return": 10.0 * update + (resume or 0)})
        log.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload().Scalars("progress/return")
    assert [(event.step, event.value) for event in events] == [(1, 10.0), (2, 20.0), (3, 32.0), (4, 42.0)]


def test_reports_of_baselines(tmp_path):
    """The four files of a report: the first that does not go through is named."""
    run = write_run(tmp_path / "runs" / "0", [0.0] * 3)
    with small_file_limit(1), pytest.raises(WriteError, match=r"cannot write .*curves\.csv"):
        write_report(tmp_path, {("cartstem", "ppo"): [run]})
    assert os.listdir(tmp_path) == ["runs"]
