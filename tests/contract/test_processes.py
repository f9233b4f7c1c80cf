"""Processes: children end with their parent, interrupts are heard, many start with one empty cache, any home does."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # s
SOON = 5.0  # s: the grace of 1.5 s, and a machine that does other things


def start(*arguments: str, program: str = "", **more: Any) -> subprocess.Popen[str]:
    """A ``softwarp`` command, or a Python program, in a process of its own."""
    command = [sys.executable, *(("-c", program) if program else ("-m", "softwarp")), *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"} | more.pop("env", {})
    return subprocess.Popen(command, env=environment, cwd=ROOT, text=True, stderr=subprocess.PIPE, **more)


def wait_for(condition: Callable[[], Any], what: str) -> Any:
    """The first true value."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.05)
    raise AssertionError(f"not within {PATIENCE:g} s: {what}")


def is_alive(process: int) -> bool:
    """Whether a process runs; one that has ended and waits to be asked does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


PARENT = """
import os, subprocess, sys, time
from softwarp import processes

child = subprocess.Popen([sys.executable, "-c", sys.argv[1]], **processes.child_options(dict(os.environ)))
print(child.pid, flush=True)
time.sleep(600)
"""
CHILD = """
import signal, sys, time
from softwarp import processes

processes.end_with_parent()
signal.signal(signal.SIGTERM, lambda *_: (print("saved", flush=True), sys.exit()))
print("ready", flush=True)
time.sleep(600)
"""


def test_kill_leaves_no_children() -> None:
    """kill -9 of a command ends those that it has started, by a signal in answer to which they can save."""
    parent = start(CHILD, program=PARENT, stdout=subprocess.PIPE)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert parent.stdout.readline() == "ready\n"
    parent.kill()
    parent.wait()
    wait_for(lambda: not is_alive(child), "the child has ended")
    assert parent.stdout.read() == "saved\n"
    parent.communicate()


RANK = """
import time
from softwarp import processes

processes.end_with_launcher()
print("ready", flush=True)
time.sleep(600)
"""


def test_ranks_end_with_their_launcher() -> None:
    """A rank whose launcher was gone before it could look ends; a process that nobody launched stays."""
    told = {"LOCAL_RANK": "0", "TORCHELASTIC_RUN_ID": "run"}
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    lost = start(program=RANK, stdout=subprocess.PIPE, env=told | {"SOFTWARP_LAUNCHER": str(gone.pid)})
    alone = start(program=RANK, stdout=subprocess.PIPE)
    assert lost.wait(PATIENCE) == -signal.SIGTERM
    assert alone.stdout is not None
    assert alone.stdout.readline() == "ready\n"
    assert alone.poll() is None
    for process in (lost, alone):
        process.kill()
        process.communicate()


POOL = """
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from softwarp.processes import serve_parent

with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=serve_parent) as pool:
    print(pool.submit(os.getpid).result(), flush=True)
    time.sleep(600)
"""


def test_kill_leaves_no_pool() -> None:
    """kill -9 of a command ends its pool of processes, which waits for work that nobody sends."""
    parent = start(program=POOL, stdout=subprocess.PIPE)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.kill()
    wait_for(lambda: not is_alive(worker), "the pool has ended")
    parent.communicate()


NATIVE = """
import hashlib
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
from softwarp import processes, threads

with processes.hearing_interrupts("train"):
    {turn}
        print("ready", flush=True)
        hashlib.pbkdf2_hmac("sha256", b"", b"", {rounds})
        print("done", flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupts_are_heard_while_kernels_compile(number: int) -> None:
    """A command ends within seconds of a signal although its main thread is in a compiler; here, in a long digest."""
    process = start(program=HANDLER + NATIVE.format(turn="with threads.alone:", rounds=10**9), stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.3)  # until it is in the digest
    process.send_signal(number)
    begun = time.monotonic()
    assert process.wait(PATIENCE) == 128 + number
    assert time.monotonic() - begun < SOON
    assert "train: interrupted while kernels were compiled" in process.communicate()[1]


HANDLER = """
import signal
signal.signal(signal.SIGTERM, lambda *_: None)  # as while a policy is trained: a request
"""


def test_other_native_work_is_not_cut_short() -> None:
    """A step or an update goes on to its end, after which Python hears the signal."""
    process = start(program=NATIVE.format(turn="if True:", rounds=5 * 10**6), stdout=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, told = process.communicate()
    assert "KeyboardInterrupt" in told
    assert "compiled" not in told


DRAW = """
import warp as wp
import torch
from softwarp.envs.randomization import uniform

print(uniform(torch.tensor([5]), torch.tensor([0]), torch.tensor([0]), 0, 3).tolist(), flush=True)
"""
SCENES = """
import sys
from tests.thread_cases import SCENES, rods

bits = [SCENES[name]() for name in sys.argv[1:]]
print([float(value.double().sum()) for part in bits for value in part.values()], flush=True)
"""


def run_together(count: int, program: str, *arguments: str, cache: Path) -> list[str]:
    """What processes print that start at once with an empty cache of kernels."""
    cache.mkdir()
    more: dict[str, Any] = {"env": {"WARP_CACHE_PATH": str(cache)}, "stdout": subprocess.PIPE}
    begun = [start(*arguments, program=program, **more) for _ in range(count)]
    told = [process.communicate() for process in begun]
    assert [process.returncode for process in begun] == [0] * count, [error for _, error in told]
    return [text.splitlines()[-1] for text, _ in told]


COMPILE = """
import sys
import warp as wp
from softwarp import threads
from warp._src import build

threads.begin()
build_cpu, built = build.build_cpu, []
build.build_cpu = lambda *arguments, **named: (built.append(1), build_cpu(*arguments, **named))[1]

@wp.kernel
def double(x: wp.array(dtype=float)):
    i = wp.tid()
    x[i] = 2.0 * x[i]

@wp.kernel(module="other")
def triple(x: wp.array(dtype=float)):
    i = wp.tid()
    x[i] = 3.0 * x[i]

x = wp.ones(4, dtype=float, device="cpu")
sys.stdin.readline()
for kernel in (double, triple):
    wp.launch(kernel, 4, inputs=[x], device="cpu")
assert x.numpy().tolist() == [6.0] * 4
print(len(built), flush=True)
"""


def test_a_module_is_compiled_once_for_all(tmp_path: Path) -> None:
    """Of two processes that need it one compiles it, by headers that are parsed once for all; nothing else stays."""
    file = tmp_path / "program.py"
    file.write_text(COMPILE)
    more: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    program = f"import runpy; runpy.run_path({str(file)!r})"
    cache = tmp_path / "cache"
    begun = [start(program=program, env={"WARP_CACHE_PATH": str(cache)}, **more) for _ in range(2)]
    told = [process.communicate("\n") for process in begun]
    assert sum(int(text) for text, _ in told) == 2, told
    assert len(list(cache.rglob("*.pch"))) == 1
    assert not list(cache.rglob("*softwarp-lock"))


@pytest.mark.slow
def test_processes_with_one_empty_cache(tmp_path: Path) -> None:
    """Two processes compile the same kernel at the same time; nothing unfinished stays."""
    assert len(set(run_together(2, DRAW, cache=tmp_path / "cache"))) == 1
    assert not list(tmp_path.rglob("*_p[0-9]*_t[0-9]*"))


@pytest.mark.slow
def test_many_processes_with_one_empty_cache(tmp_path: Path) -> None:
    """Eight processes make and step the same scenes, and see the same bits."""
    names = ("rods", "trunk, neo-Hookean")
    assert len(set(run_together(8, SCENES, *names, cache=tmp_path / "cache"))) == 1


def test_machine_without_a_home(tmp_path: Path) -> None:
    """Without a home that can be written to, what has to be set is said; set, everything works."""
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null", "WARP_CACHE_PATH": ""}
    bare = {name: value for name, value in (os.environ | nowhere).items() if name != "WARP_CACHE_PATH"}
    bare |= {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", "from softwarp import threads; threads.begin()"]
    refused = subprocess.run(command, env=bare, cwd=ROOT, capture_output=True, text=True, check=False)
    assert refused.returncode == 1
    assert "/dev/null" in refused.stderr.splitlines()[-1]
    assert "set the environment variable WARP_CACHE_PATH" in refused.stderr.splitlines()[-1]
    bare["WARP_CACHE_PATH"] = str(tmp_path)
    subprocess.run(command, env=bare, cwd=ROOT, check=True)
