"""Commands in forked processes end as those in interpreters of their own."""

import subprocess
import sys
import time

import pytest

from tests import forked

PROGRAMS = {
    "output": "import sys; print('out', sys.argv[1:]); print('err', file=sys.stderr)",
    "code": "raise SystemExit(3)",
    "message": "import sys; sys.exit('told')",
    "error": "1 / 0",
    "signal": "import os; os.kill(os.getpid(), 9)",
    "input": "import sys; print(repr(sys.stdin.read()))",
    "folder": "import os; print(os.getcwd()); open('made', 'w').write('x')",
    "end": "import atexit; atexit.register(print, 'at exit'); print('before', end=' ')",
    "name": "print(__name__)",
}


def ended(done: subprocess.CompletedProcess[str]) -> tuple[int, str, str]:
    """What it was told, of errors the last line."""
    return done.returncode, done.stdout, "".join(done.stderr.splitlines()[-1:])


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_forked_command_ends_as_a_fresh_one(name, tmp_path):
    """Its code, its output, its errors, its folder, as a program and as a file."""
    (tmp_path / "program.py").write_text(PROGRAMS[name])
    for arguments in (["-c", PROGRAMS[name], "a", "b c"], [str(tmp_path / "program.py"), "a"]):
        fresh = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, stdin=subprocess.DEVNULL
        )
        assert ended(forked.run(arguments, tmp_path)) == ended(fresh)


def test_torch_is_there_and_nothing_has_begun(tmp_path):
    """A module as a command, too; the one after it starts as clean, and changes of one are not seen by another."""
    program = "import sys; print('torch' in sys.modules, 'x' in vars(sys)); sys.x = 1; from softwarp import threads; "
    program += "print(threads._has_begun); threads.begin()"
    for _ in range(2):
        assert forked.run(["-c", program], tmp_path).stdout == "True False\nFalse\n"
    assert forked.run(["-m", "softwarp", "trian"], tmp_path).returncode == 2


@pytest.mark.slow
def test_what_takes_too_long_is_ended(tmp_path):
    """And the next command runs; in a new process, which has loaded all packages by then."""
    forked.run(["-c", ""], tmp_path)
    began = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        forked.run(["-c", "import time; time.sleep(60)"], tmp_path, patience=0.5)
    assert time.monotonic() - began < 10.0
    assert forked.run(["-c", "print(1)"], tmp_path).stdout == "1\n"
