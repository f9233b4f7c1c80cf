"""Programs that use softwarp: nothing is told but that kernels are compiled, and that only where it takes long."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.contract.terminal import RENEWED, ROOT, Terminal

STEP = """
import softwarp as sw

builder = sw.ModelBuilder()
rod = builder.add_rod([(0.1 * i, 0, 0) for i in range(3)], radius=0.01, youngs=1e6, nu=0.4, density=1000.0)
builder.fix(rod, nodes=[0])
sim = sw.Simulation(builder.finalize(), dt=0.01)
sim.step()
"""
IMPATIENT = "from softwarp import compiling; compiling.QUIET_SECONDS = 0.05"
COMPILE = """
from softwarp import compiling, threads
import warp as wp
compiling.QUIET_SECONDS = 0.05
threads.begin()

@wp.kernel
def double(x: wp.array(dtype=float)):
    i = wp.tid()
    x[i] = 2.0 * x[i]

x = wp.ones(4, dtype=float, device="cpu")
wp.launch(double, 4, inputs=[x], device="cpu")
assert x.numpy().tolist() == [2.0] * 4
"""


def run(program: str, tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A program without a terminal; Warp finds the source of kernels in a file."""
    file = tmp_path / "program.py"
    file.write_text(program)
    more = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    return subprocess.run([sys.executable, str(file)], env=more, capture_output=True, text=True, check=True, cwd=ROOT)


def without_notice(text: str) -> list[str]:
    """Lines but for those about kernels that this machine had not compiled yet."""
    return [line for line in text.splitlines() if not line.startswith(("compiling kernels: ", "compiled "))]


def test_a_script_prints_nothing(tmp_path: Path) -> None:
    """No banner, no line about a missing driver, none for every module that is loaded."""
    done = run(STEP, tmp_path)
    assert done.stdout == ""
    assert without_notice(done.stderr) == []


@pytest.mark.parametrize(
    ("before", "variable", "stream"),
    [
        ("", "1", "stdout"),
        ("import logging; logging.getLogger('softwarp').setLevel('INFO')", "", "stdout"),
        pytest.param("import logging; logging.basicConfig(level=logging.INFO)", "", "stderr", marks=pytest.mark.slow),
        pytest.param("import warp as wp; wp.config.log_level = wp.LOG_DEBUG", "", "stdout", marks=pytest.mark.slow),
        ("import warp as wp; wp.set_logger(type('Own', (), dict.fromkeys(DIR, print))())", "", "stdout"),
    ],
)
def test_lines_of_warp_come_back(tmp_path: Path, before: str, variable: str, stream: str) -> None:
    """By a variable or by Python's logging; and who has told Warp what to write before, or where, is obeyed."""
    before = before.replace("DIR", "('debug', 'info', 'warning', 'error')")
    done = run(before + "\nfrom softwarp import threads\nthreads.begin()", tmp_path, SOFTWARP_VERBOSE=variable)
    assert "Kernel cache:" in getattr(done, stream)


def test_compiling_is_told_and_loading_is_not(tmp_path: Path) -> None:
    """On a terminal in a line that is renewed; the second time there is nothing to tell."""
    cache = {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    (tmp_path / "program.py").write_text(COMPILE)
    terminal = Terminal(str(tmp_path / "program.py"), env=cache)
    assert terminal.wait() == 0
    assert terminal.text.startswith(f"{RENEWED}compiling kernels: the first file, ")
    assert f"{RENEWED}compiled 1 file of kernels in " in terminal.text
    assert run(COMPILE, tmp_path, **cache).stderr == ""


@pytest.mark.slow
def test_interrupt_while_modules_compile_side_by_side(tmp_path: Path) -> None:
    """Ctrl-C in a script ends it when the modules in work are done, and begins no more of them."""
    (tmp_path / "program.py").write_text(STEP.replace("import softwarp as sw", "import softwarp as sw\n" + IMPATIENT))
    terminal = Terminal(str(tmp_path / "program.py"), env={"WARP_CACHE_PATH": str(tmp_path / "cache")})
    terminal.read("compiling kernels: ")
    terminal.interrupt()
    assert terminal.wait() != 0
    assert "KeyboardInterrupt" in terminal.text
    done, of = map(int, re.findall(r"compiling kernels: (\d+) of about (\d+)", terminal.text)[-1])
    assert done < of - 2
