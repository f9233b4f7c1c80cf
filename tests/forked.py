"""Commands that tests type, in processes forked from one that has loaded Torch: the same command without the seconds.

For tests of what a command does, not of how it starts. The process that is forked has imported packages and done
nothing else: neither Warp nor CUDA has begun, and it has no threads but its own.
"""

import atexit
import functools
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
SERVER = """
import atexit, json, os, runpy, sys, threading, traceback

for name in ("torch", "torchrl.envs", "torchrl.collectors", "gymnasium", "hydra", "warp", "softwarp.envs.base",
             "softwarp.cli", "softwarp.training.loop", "softwarp.planning.plans", "softwarp.io.usd"):
    __import__(name)
from softwarp import threads

assert not threads._has_begun and threading.active_count() == 1, threading.enumerate()


def serve(job):
    for stream, file in ((1, job["out"]), (2, job["err"])):
        os.dup2(os.open(file, os.O_WRONLY | os.O_APPEND), stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.chdir(job["cwd"])
    kind, *rest = job["arguments"]
    code = 0
    try:
        if kind == "-m":
            sys.argv, sys.path[0] = rest, os.getcwd()
            runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
        elif kind == "-c":
            sys.argv = ["-c", *rest[1:]]
            exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
        else:
            sys.argv, sys.path[0] = [kind, *rest], os.path.dirname(os.path.abspath(kind))
            runpy.run_path(kind, run_name="__main__")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        if code == 1 and not isinstance(end.code, int):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    return code


for line in sys.stdin:
    job = json.loads(line)
    child = os.fork()
    if child == 0:
        code = serve(job)
        threading._shutdown()  # as Python ends, but for taking modules apart
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code % 256)
    print(json.dumps(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])), file=sys.__stdout__, flush=True)
"""


@functools.cache
def _server() -> subprocess.Popen[str]:
    """The process that is forked; one for each process of pytest."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER], text=True, env=environment, start_new_session=True, **streams
    )
    atexit.register(server.kill)
    return server


def run(arguments: Sequence[object], cwd: Path, patience: float = 300.0) -> subprocess.CompletedProcess[str]:
    """Run ``python ARGUMENTS`` in a folder to its end: ``-m module ...``, ``-c program ...`` or ``file.py ...``.

    Raises:
        TimeoutExpired: After so many seconds.
    """
    server = _server()
    assert server.stdin is not None and server.stdout is not None
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder, "out"), Path(folder, "err")
        job = {"arguments": [str(word) for word in arguments], "cwd": str(cwd), "out": str(out), "err": str(err)}
        for file in (out, err):
            file.touch()
        server.stdin.write(json.dumps(job) + "\n")
        server.stdin.flush()
        if not select.select([server.stdout], [], [], patience)[0]:
            os.killpg(server.pid, signal.SIGKILL)  # the command, too; the next one has a new process to be forked
            _server.cache_clear()
            raise subprocess.TimeoutExpired(job["arguments"], patience, out.read_text(), err.read_text())
        answer = server.stdout.readline()
        assert answer, f"the process to be forked has ended with {server.wait()}"
        return subprocess.CompletedProcess(job["arguments"], json.loads(answer), out.read_text(), err.read_text())
