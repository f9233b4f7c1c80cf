"""Other meshers: pytetwild, an optional package, and gmsh, a program that the user installs."""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from softwarp.meshing.shells import Shells
from softwarp.meshing.tets import FloatArray, IntArray, MeshError

PROGRAM = "gmsh"
PATIENCE = 1800.0  # s
LITTER = "__tracked_surface.stl"  # what fTetWild leaves in the working directory
_FEATURE = 35.0  # degree between triangles above which gmsh keeps an edge
_SCRIPT = """Merge "surface.stl";
Mesh.MeshSizeMin = {edge:.17g};
Mesh.MeshSizeMax = {edge:.17g};
Mesh.MeshSizeFromPoints = 0;
Mesh.MeshSizeFromCurvature = 0;
Mesh.MeshSizeExtendFromBoundary = 0;
ClassifySurfaces{{{angle:.17g}, 1, 1, Pi}};
CreateGeometry;
Surface Loop(1) = Surface{{:}};
Volume(1) = {{1}};
Mesh.Optimize = 1;
Mesh.SaveAll = 1;
"""


def has_tetwild() -> bool:
    """Whether pytetwild is installed, with what it needs."""
    if importlib.util.find_spec("pytetwild") is None:
        return False
    try:
        importlib.import_module("pytetwild")
    except ImportError:
        return False
    return True


def tetwild(vertices: FloatArray, triangles: IntArray, edge: float) -> tuple[FloatArray, IntArray]:
    """Nodes and tetrahedra of fTetWild (Hu, Schneider, Wang, Zorin, Panozzo 2020).

    Raises:
        ImportError: If pytetwild is missing.
    """
    try:
        pytetwild = importlib.import_module("pytetwild")
    except ImportError as error:
        raise ImportError(
            f"method 'tetwild' needs the package pytetwild ({error}); install it with pip install "
            f"\"softwarp[tetwild]\", or take method='lattice'"
        ) from error
    litter = Path(LITTER)
    is_mine = not litter.exists()
    nodes, tets = pytetwild.tetrahedralize(vertices, np.ascontiguousarray(triangles), edge_length_abs=edge, quiet=True)
    if is_mine:
        litter.unlink(missing_ok=True)
    return np.asarray(nodes, dtype=np.float64), np.asarray(tets, dtype=np.int32)


def gmsh(shells: Shells, edge: float) -> tuple[FloatArray, IntArray]:
    """Nodes and tetrahedra of the program gmsh, which runs as a process of its own and is spoken to by files.

    Raises:
        ImportError: If there is no such program.
        MeshError: If it fails.
    """
    program = shutil.which(PROGRAM)
    if program is None:
        raise ImportError(
            f"method 'gmsh' runs the program {PROGRAM!r}, which is not on the PATH. It is under the GPL and not part "
            f"of softwarp: install it yourself from gmsh.info, or take method='lattice'"
        )
    label = shells.surface.name
    with tempfile.TemporaryDirectory() as folder:
        _write_stl(Path(folder, "surface.stl"), shells.surface.nodes, shells.surface.triangles)
        Path(folder, "solid.geo").write_text(_SCRIPT.format(edge=edge, angle=np.radians(_FEATURE)))
        command = [program, "-3", "-format", "msh22", "-v", "2", "-o", "solid.msh", "solid.geo"]
        try:
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False)
        except subprocess.TimeoutExpired:
            raise MeshError(f"surface {label!r}: gmsh took more than {PATIENCE:g} s; take longer edges") from None
        output = Path(folder, "solid.msh")
        if done.returncode != 0 or not output.exists():
            told = " ".join((done.stderr or done.stdout).split())[-300:]
            raise MeshError(f"surface {label!r}: gmsh failed ({told}); try method='lattice' or method='tetwild'")
        found = importlib.import_module("meshio.gmsh").read(str(output))
    blocks = [np.asarray(block.data) for block in found.cells if block.type == "tetra"]
    if not blocks:
        raise MeshError(f"surface {label!r}: gmsh made no tetrahedra; try method='lattice' or method='tetwild'")
    return np.asarray(found.points, dtype=np.float64), np.concatenate(blocks).astype(np.int32)


def _write_stl(path: Path, vertices: FloatArray, triangles: IntArray) -> None:
    """Text, so that positions keep all their digits."""
    lines = ["solid surface"]
    for corner in vertices[triangles]:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x:.17g} {y:.17g} {z:.17g}" for x, y, z in corner]
        lines += ["endloop", "endfacet"]
    path.write_text("\n".join([*lines, "endsolid surface", ""]))
