"""What softwarp is installed with is written down and agrees; files that it reads run no code."""

import ast
import importlib
import json
import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import torch
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
SOURCES = [path for folder in ("softwarp", "experiments") for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.fixture(scope="module")
def ci():
    """A function that imports a script of ``.ci``."""
    names = ("supply", "constraints", "licences", "lock", "sbom", "requirements")
    sys.path.insert(0, str(ROOT / ".ci"))
    yield importlib.import_module
    sys.path.remove(str(ROOT / ".ci"))
    for name in names:
        sys.modules.pop(name, None)


def constraints() -> dict[str, str]:
    """Version by canonical name."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return {
        canonicalize_name(name): version
        for name, _, version in (line.partition("==") for line in lines if not line.startswith("#"))
    }


def is_as_tested(supply) -> bool:
    """Whether what is installed here by name has the versions of constraints.txt; newer ones may need more."""
    held, here = constraints(), supply.installed()
    return all(held.get(name) == here[name].version for name in supply.direct())


def test_constraints_hold_tested_versions_of_everything(ci):
    """Each direct dependency has a line within the bounds of pyproject.toml, and where these are installed all others.

    No line leads to a folder, an address or a commit.
    """
    supply, held = ci("supply"), constraints()
    for wanted in supply.declared((*supply.EXTRAS, *supply.HELD)):
        version = held.get(canonicalize_name(wanted.name))
        assert version, f"{wanted.name} is missing: run .ci/constraints.py where the tests have passed"
        assert version in wanted.specifier, f"{wanted.name}: {version} was tested, pyproject.toml asks for {wanted}"
    if is_as_tested(supply):
        assert set(supply.installed()) <= set(held), "run .ci/constraints.py where the tests have passed"
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    assert all(re.fullmatch(r"#.*|[\w.-]+==[\w.+!-]+", line) for line in text.splitlines())
    assert "@" not in text and "://" not in text


def test_constraints_of_absent_extras_are_kept_or_taken_from_pip(ci):
    """What is installed has its own version; others keep theirs, in the order of canonical names."""
    made, supply = ci("constraints"), ci("supply")
    lines = made.text({"Zzz.other": "1.0", "torch": "0.1"}).splitlines()
    assert lines[-1] == "Zzz.other==1.0" and f"torch=={metadata.version('torch')}" in lines
    assert {canonicalize_name(name) for name in made.written()} == set(constraints())
    report = {"install": [{"metadata": {"name": name, "version": "2"}} for name in ("softwarp", "a")]}
    assert made.reported(report) == {"a": "2"}
    assert not set(supply.HELD) & set(supply.EXTRAS)


def test_locked_versions_are_the_tested_ones(ci):
    """The lines with checksums are those of constraints.txt; a report of pip becomes such lines, softwarp left out."""
    lines = (ROOT / "locked.txt").read_text(encoding="utf-8").splitlines()
    pattern = re.compile(r"([\w.-]+)==(\S+) --hash=sha256:[0-9a-f]{64}")
    found = [pattern.fullmatch(line) for line in lines if not line.startswith("#")]
    assert all(found)
    assert {canonicalize_name(match[1]): match[2] for match in found} == constraints()

    def item(name):
        archive = {"archive_info": {"hashes": {"sha256": "ab"}}, "url": "file:///here"}
        return {"metadata": {"name": name, "version": "1.0"}, "download_info": archive}

    machine = {"platform_system": "Linux", "platform_machine": "x86_64", "python_version": "3.11"}
    told = ci("lock").text({"environment": machine, "install": [item("softwarp"), item("other")]})
    assert told.splitlines()[2:] == ["other==1.0 --hash=sha256:ab"]


def test_licences_of_dependencies_are_listed(ci):
    """Each direct dependency has a line, in tested versions with the licence that it tells, and so have all others."""
    supply, licences = ci("supply"), ci("licences")
    rows = dict(re.findall(r"^\| (\S+) \| (.+) \|$", (ROOT / "docs" / "licences.md").read_text(), re.MULTILINE))
    told = {canonicalize_name(name): text for name, text in rows.items()}
    assert supply.direct() <= set(told), "run .ci/licences.py"
    assert "unknown" not in told.values()
    if is_as_tested(supply):
        for name in supply.direct():
            assert told[name] == licences.licence(name, metadata.distribution(name)), f"run .ci/licences.py: {name}"
        assert set(supply.installed()) <= set(told)


def test_licences_of_other_extras_are_listed(ci):
    """Packages of extras that tests do without stand in the page too, and are none that are tested with."""
    supply, listed = ci("supply"), ci("licences").LEFT_TO_USERS
    others = set(supply.PROJECT["optional-dependencies"]) - set(supply.EXTRAS)
    wanted = {canonicalize_name(requirement.name) for requirement in supply.declared(others)}
    assert wanted - supply.direct() == set(listed)
    page = (ROOT / "docs" / "licences.md").read_text()
    assert all(f"| {name} | {told} |" in page for name, told in listed.items()), "run .ci/licences.py"


def test_bill_of_materials_is_whole(ci):
    """Every reference leads to a component once; what softwarp asks for is what it depends on; the same each time."""
    bill = ci("sbom").bill()
    assert json.loads(json.dumps(bill)) == bill == ci("sbom").bill()
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    root = bill["metadata"]["component"]
    refs = [component["bom-ref"] for component in bill["components"]]
    assert len(set(refs)) == len(refs)
    graph = {entry["ref"]: entry["dependsOn"] for entry in bill["dependencies"]}
    assert set(graph) == {root["bom-ref"], *refs}
    assert {need for needs in graph.values() for need in needs} == set(refs)  # nothing hangs in the air
    assert f"pkg:pypi/torch@{metadata.version('torch')}" in graph[root["bom-ref"]]
    direct = [entry for entry in bill["components"] if entry["bom-ref"] in graph[root["bom-ref"]]]
    assert all(entry["licenses"][0]["license"]["name"] != "unknown" for entry in direct)


def test_bounds_can_be_left_out(ci):
    """For the job that tries what comes next: lower bounds stay, upper ones go, extras and markers stay."""
    unbounded = ci("requirements").unbounded
    wanted = unbounded(Requirement('a[b]>=1.2,<2,!=1.5; python_version >= "3.11"'))
    assert wanted.specifier == SpecifierSet(">=1.2,!=1.5") and wanted.extras == {"b"} and wanted.marker is not None
    for script in (".ci/newest", ".ci/run"):
        assert os.access(ROOT / script, os.X_OK)
        subprocess.run(["bash", "-n", str(ROOT / script)], check=True)
    done = subprocess.run([str(ROOT / ".ci" / "newest"), "--older"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "usage: .ci/newest [--beyond]\n")


SUSPECT = re.compile(r"\b(eval|exec|yaml|\w*pickle|dill|marshal|shelve|joblib)\b|\.\s*load\b")


def unsafe(path: Path) -> list[str]:
    """Calls of a source file that could run what a file brings."""
    found: list[str] = []
    text = path.read_text(encoding="utf-8")
    if not SUSPECT.search(text):  # most files: trees of all take ten seconds
        return found
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        is_unsafe = called in ("eval", "exec", "yaml.load", "yaml.unsafe_load")
        is_unsafe |= bool(
            re.match(r"(c?pickle|dill|cloudpickle|marshal|shelve|joblib)\.(loads?|open|Unpickler)$", called)
        )
        if called in ("torch.load", "np.load", "numpy.load"):
            given = {word.arg: ast.unparse(word.value) for word in node.keywords}
            is_unsafe |= called == "torch.load" and given.get("weights_only") != "True"
            is_unsafe |= called != "torch.load" and given.get("allow_pickle", "False") != "False"
        if is_unsafe:
            found.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    return found


def test_files_are_read_as_data(tmp_path):
    """No pickle is loaded, no text is run: ``torch.load`` has weights_only, ``np.load`` never allows pickles."""
    assert not [call for path in SOURCES for call in unsafe(path)]
    calls = ["torch.load(f)", "np.load(f, allow_pickle=True)", "pickle.load(f)", "eval(text)"]
    (tmp_path / "a.py").write_text(
        "\n".join([*calls, "policy.eval()", "np.load(f)", "torch.load(f, weights_only=True)"])
    )
    assert unsafe(tmp_path / "a.py") == [f"a.py:{line}: {call}" for line, call in enumerate(calls, 1)]


class Payload:
    """Runs when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


def test_payloads_in_files_do_not_run(tmp_path):
    """A checkpoint, a snapshot, a recording and demonstrations with a program in them are refused and do nothing."""
    from softwarp.io.trajectory import Trajectory
    from softwarp.snapshot import Snapshot
    from softwarp.training.checkpoints import load
    from softwarp.training.demonstrations import Demonstrations

    mark = tmp_path / "ran"
    torch.save(
        {"format": "softwarp checkpoint", "version": 1, "kind": "policy", "policy": Payload(mark)}, tmp_path / "a.pt"
    )
    np.savez(tmp_path / "a.npz", header=np.array([Payload(mark)], dtype=object))
    for read, name in (
        (load, "a.pt"),
        (Snapshot.load, "a.npz"),
        (Trajectory.load, "a.npz"),
        (Demonstrations.load, "a.npz"),
    ):
        with pytest.raises(ValueError, match=r"a\.(pt|npz)"):
            read(tmp_path / name)
    assert not mark.exists()
