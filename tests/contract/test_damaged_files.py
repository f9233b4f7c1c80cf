"""Files that are cut, altered, foreign or meant to harm: read rightly, or refused by one clear error of ours.

Every reader of files that a user hands in is tried with every kind of damage. An error is clear if it is a ValueError
or OSError that is raised in softwarp itself and names the file.
"""

import io
import json
import os
import pickle
import random
import re
import resource
import struct
import traceback
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from softwarp import meshing
from softwarp.io import bounded
from softwarp.io.mesh import read_mesh
from softwarp.io.trajectory import Trajectory
from softwarp.io.urdf import read_urdf
from softwarp.planning import picture, plans
from softwarp.snapshot import Snapshot
from softwarp.training import checkpoints
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.logs import read_csv
from tests.contract.test_writers import DATA, demonstrations, snapshot
from tests.unit.io.fakes import recording

SEEDS = 40  # altered files per reader
MOST_MEMORY = 2**28  # bytes that refusing a file may take


def mesh_file(path: Path) -> None:
    """A block of tetrahedra, or its surface, in the format of the suffix."""
    block = meshing.box((1.0, 1.0, 2.0), (2, 2, 3))
    if path.suffix in (".stl", ".obj", ".ply", ".off"):
        import trimesh

        trimesh.Trimesh(block.nodes, block.surface(), process=False).export(str(path))
        return
    import meshio

    kind = {".vtk": "vtk42", ".vtu": "vtu", ".msh": "gmsh22"}[path.suffix]
    meshio.Mesh(block.nodes, [("tetra", block.tets)]).write(str(path), file_format=kind)


def robot_file(path: Path) -> None:
    """Two links with masses and shapes, and a hinge between them."""
    link = """<link name="{0}"><inertial><origin xyz="0 0 0.1" rpy="0 0.1 0"/><mass value="2"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><geometry><box size="0.1 0.1 0.2"/></geometry></collision>
      <collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision></link>"""
    joint = """<joint name="hinge" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.2"/>
      <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="2" velocity="3"/></joint>"""
    path.write_text(f'<robot name="r">{link.format("a")}{link.format("b")}{joint}</robot>')


def read_checkpoint(path: Path) -> None:
    checkpoints.build_policy(checkpoints.load(path))


def copied(name: str):
    return lambda path: path.write_bytes((DATA / name).read_bytes())


# What writes a whole file, and what reads it.
READERS = {
    "policy.pt": (copied("ppo/best.pt"), read_checkpoint),
    "step.pt": (copied("memory/checkpoints/step_000000000064.pt"), read_checkpoint),
    "snapshot.npz": (lambda path: snapshot().save(path), Snapshot.load),
    "demonstrations.npz": (lambda path: demonstrations().save(path), Demonstrations.load),
    "trajectory.npz": (lambda path: recording(3).save(path), Trajectory.load),
    "plan.json": (copied("plan_tree.json"), plans.Plan.load),
    "sequence.json": (copied("plan_sequence.json"), plans.Plan.load),
    "evaluation.csv": (copied("ppo/evaluation.csv"), read_csv),
    **{f"mesh.{suffix}": (mesh_file, read_mesh) for suffix in ("vtk", "vtu", "msh", "stl", "obj", "ply", "off")},
    "robot.urdf": (robot_file, read_urdf),
}


def is_read_or_refused(name: str, path: Path) -> str | None:
    """The message if the file was refused; fails if the error is not a clear one of ours."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        READERS[name][1](path)
    except (ValueError, OSError) as error:
        place = traceback.extract_tb(error.__traceback__)[-1].filename
        assert "/softwarp/" in place, f"raised in {place}: {error!r}"
        assert path.name in str(error), f"names no file: {error}"
        assert len(str(error)) < 600
        return str(error)
    finally:
        assert 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) < MOST_MEMORY
    return None


@pytest.fixture(params=READERS)
def whole(request, tmp_path):
    """Name of a reader and a file that it reads."""
    path = tmp_path / request.param
    READERS[request.param][0](path)
    assert is_read_or_refused(request.param, path) is None
    return request.param, path


def test_cut_altered_and_foreign_files(whole, tmp_path):
    """Cut at ten places; a few bytes changed, by seeds; empty, random, text; the file of each other reader."""
    name, path = whole
    content = path.read_bytes()
    refused = 0
    for part in range(10):
        path.write_bytes(content[: len(content) * part // 10])
        refused += is_read_or_refused(name, path) is not None
    assert refused >= 8 or path.suffix in (".obj", ".csv", ".stl", ".off")  # of which a part may be a whole
    for seed in range(SEEDS):
        rng = random.Random(seed)
        altered = bytearray(content)
        for _ in range(rng.choice((1, 4, 32))):
            altered[rng.randrange(len(altered))] ^= 1 << rng.randrange(8)
        path.write_bytes(altered)
        is_read_or_refused(name, path)
    for other in (b"", b"hello", random.Random(0).randbytes(4096), b"[" * 200_000, b"\x80\x04.", b"PK\x03\x04"):
        path.write_bytes(other)
        is_read_or_refused(name, path)
    for other in READERS:
        if Path(other).suffix != path.suffix or other[:4] != name[:4]:
            READERS[other][0](tmp_path / other)
            path.write_bytes((tmp_path / other).read_bytes())
            is_read_or_refused(name, path)
    path.unlink()
    if path.suffix != ".csv":  # a table that does not exist has no rows
        assert is_read_or_refused(name, path) is not None
        path.mkdir()
        assert is_read_or_refused(name, path) is not None


def npz_of(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def npy(shape: str, data: bytes = bytes(64), kind: str = "<f8") -> bytes:
    """A file of numpy whose header says what it is told to."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


ARRAYS = ["snapshot.npz", "demonstrations.npz", "trajectory.npz"]


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
def test_headers_of_arrays_that_ask_for_too_much(name, compression, tmp_path):
    """7.45 GiB in a header of 64 bytes, negative and absurd shapes, Python objects, deep headers."""
    path = tmp_path / name
    for shape, kind in (
        ("(1000000000,)", "<f8"),
        ("(1000000000000, 1000000000000)", "<f8"),
        ("(-1,)", "<f8"),
        ("(8.0,)", "<f8"),
        ("(8,)", "|O"),
        ("(8,)", "<f3"),
        ("(" * 90 + ")" * 90, "<f8"),
        ("(0, 1000000000000)", "<f8"),
    ):
        npz_of(path, {"header.npy": npy(shape, kind=kind), "format.npy": npy(shape, kind=kind)}, compression)
        assert is_read_or_refused(name, path)


@pytest.mark.parametrize("name", ARRAYS)
def test_archives_that_lie_about_their_sizes(name, tmp_path, monkeypatch):
    """More unpacked than the packed bytes can hold, than memory has, or twice the same name."""
    path = tmp_path / name
    npz_of(path, {"header.npy": npy("(1000000,)", bytes(8_000_000))}, zipfile.ZIP_DEFLATED)
    content = path.read_bytes()
    size = struct.pack("<I", 8_000_000 + len(npy("(1000000,)", b"")))
    assert content.count(size) == 2
    for declared in (b"\xff\xff\xff\x7f", bytes(4)):
        path.write_bytes(content.replace(size, declared))
        assert is_read_or_refused(name, path)
    path.write_bytes(content)
    monkeypatch.setattr(bounded, "free_memory", lambda: 2**20)
    assert "unpacked it takes 7.63 MiB, 1 MiB of memory are free" in is_read_or_refused(name, path)
    monkeypatch.undo()
    with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(path, "a") as archive:
        archive.writestr("header.npy", npy("(8,)"))
    assert "two members have one name" in is_read_or_refused(name, path)


class Code:
    """An object whose pickle runs a function."""

    def __init__(self, function, *arguments) -> None:
        self.call = function, arguments

    def __reduce__(self):
        return self.call


HARMFUL = {
    "command": lambda path: Code(os.mkdir, str(path)),
    "memory": lambda path: Code(bytearray, 10**10),
    "evaluation": lambda path: Code(eval, f"__import__('os').mkdir({str(path)!r})"),
    "expanded": lambda path: torch.zeros(1).expand(10**12),
    "numpy": lambda path: np.zeros(3),
}


@pytest.mark.parametrize("kind", HARMFUL)
def test_pickles_with_code(kind, tmp_path):
    """In a checkpoint, in a plan's start, in an archive of arrays, and bare under every name: nothing of it is run."""
    made = tmp_path / "made"
    content = {"format": "softwarp checkpoint", "version": 1, "kind": "policy", "x": HARMFUL[kind](made)}
    torch.save(content, tmp_path / "policy.pt")
    assert is_read_or_refused("policy.pt", tmp_path / "policy.pt")
    plan = json.loads((DATA / "plan_tree.json").read_text())
    stream = io.BytesIO()
    torch.save(content, stream)
    plan["start"] = plans.base64.b64encode(zlib.compress(stream.getvalue())).decode()
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    assert is_read_or_refused("plan.json", tmp_path / "plan.json")
    if kind != "expanded":
        for name in READERS:
            (tmp_path / name).write_bytes(pickle.dumps(content["x"]))
            is_read_or_refused(name, tmp_path / name)
        objects = np.array([content["x"]], dtype=object)
        for name in ARRAYS:
            np.savez(tmp_path / name, header=objects, format=objects, allow_pickle=True)
            assert is_read_or_refused(name, tmp_path / name)
    assert not made.exists()


def test_packed_checkpoint_is_refused(tmp_path):
    """Torch never packs; a packed one could grow a thousandfold while it is read."""
    with zipfile.ZipFile(DATA / "ppo" / "best.pt") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    npz_of(tmp_path / "policy.pt", members, zipfile.ZIP_DEFLATED)
    assert "is packed, which softwarp never does" in is_read_or_refused("policy.pt", tmp_path / "policy.pt")


PLAN = json.loads((DATA / "plan_tree.json").read_text())
WRONG = {
    "large": {"start": plans.base64.b64encode(zlib.compress(bytes(10**8), 1)).decode()},
    "start": {"start": 3},
    "text": {"start": "not base64 at all"},
    "steps": {"steps": [{}]},
    "step": {"steps": [step | {"reward": "much"} for step in PLAN["steps"]]},
    "actions": {"actions": [[]]},
    "env": {"env": ["Trunk"]},
    "planner": {"planner": 1},
    "value": {"value": "high"},
    "cost": {"cost": {"expansions": None}},
    "spent": {"cost": {}},
    "history": {"history": [[1.0]]},
    "tree": {"tree": {"nodes": 3}},
    "columns": {"tree": PLAN["tree"] | {"value": [0.0]}},
    "parent": {"tree": PLAN["tree"] | {"parent": [10**9] * PLAN["tree"]["nodes"]}},
    "way": {"tree": PLAN["tree"] | {"plan": [-5]}},
    "version": {"version": 2},
}


@pytest.mark.parametrize("kind", WRONG)
def test_plans_with_other_content(kind, tmp_path):
    """Each entry of another type or size, and a start of 95 MiB in a file of half a megabyte."""
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(PLAN | WRONG[kind]))
    assert is_read_or_refused("plan.json", path)


def test_plans_that_are_read_can_be_drawn(tmp_path):
    """What the checks let pass has all that a picture needs."""
    for name in ("plan_tree.json", "plan_sequence.json"):
        picture.draw(plans.Plan.load(DATA / name), tmp_path / "plan.png")


@pytest.mark.parametrize("name", ["demonstrations.npz", "trajectory.npz", "snapshot.npz"])
def test_arrays_of_other_kinds(name, tmp_path):
    """Each array in turn left out, cut, of another rank, as text, as complex numbers, and one too many."""
    path = tmp_path / name
    READERS[name][0](path)
    with np.load(path) as archive:
        good = {key: archive[key] for key in archive.files}
    for key, value in good.items():
        changes = (
            value[None],
            value.astype("U9") if value.ndim else np.array("x"),
            value.astype(complex, copy=True) if value.dtype.kind in "fiub" else np.array(1j),
            value[:1] if value.ndim else np.zeros(3),
        )
        for change in changes:
            np.savez(path, **(good | {key: change}))
            is_read_or_refused(name, path)
        np.savez(path, **{other: good[other] for other in good if other != key})
        if not key.startswith(("state", "goal", "stress", "tri_membrane", "contact_", "inverted_x")):
            assert is_read_or_refused(name, path), key
    np.savez(path, surplus=np.zeros(3), **good)
    is_read_or_refused(name, path)


HUGE = b"9999999999"
COUNTS = {
    "mesh.vtk": (rb"(?<=POINTS )\d+", rb"(?<=CELLS )\d+", rb"(?<=CELLS \d\d )\d+", rb"(?<=CELL_TYPES )\d+"),
    "mesh.msh": (rb"(?<=\$Nodes\n)\d+", rb"(?<=\$Elements\n)\d+"),
    "mesh.vtu": (rb"(?<=NumberOfPoints=\")\d+", rb"(?<=NumberOfCells=\")\d+"),
}


@pytest.mark.parametrize("name", COUNTS)
def test_meshes_that_declare_too_much(name, tmp_path):
    """Counts beyond what the file can hold are refused before a parser makes room for them."""
    path = tmp_path / name
    mesh_file(path)
    content = path.read_bytes()
    for count in COUNTS[name]:
        larger, number = re.subn(count, HUGE, content)
        assert number == 1, count
        path.write_bytes(larger)
        assert "declares 9999999999" in is_read_or_refused(name, path)
    if path.suffix == ".vtk":
        path.write_bytes(b"# vtk DataFile Version 3.0\n\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 9999 9999 99\n")
        assert "only unstructured grids" in is_read_or_refused(name, path)


def test_vtu_that_unpacks_to_too_much(tmp_path):
    """A block that says it is small and unpacks to 100 MB."""
    path = tmp_path / "mesh.vtu"
    mesh_file(path)
    packed = zlib.compress(bytes(10**8), 9)
    head = struct.pack("<IIII", 1, 288, 0, len(packed))
    blob = plans.base64.b64encode(head) + plans.base64.b64encode(packed)
    content, number = re.subn(rb"(<DataArray[^>]*Points[^>]*>)[^<]*", lambda m: m.group(1) + blob, path.read_bytes())
    assert number == 1
    path.write_bytes(content)
    assert "unpacks to more than" in is_read_or_refused("mesh.vtu", path)
