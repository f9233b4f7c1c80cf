"""Write the trunk mesh to a file for other programs: python assets/trunk/generate.py medium trunk.vtu."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the generated trunk mesh to a file, in metres.")
    parser.add_argument("resolution", nargs="?", default="medium", help="coarse, medium, fine or a node count")
    parser.add_argument("output", nargs="?", type=Path, help="file to write; default: trunk_<resolution>.vtu")
    arguments = parser.parse_args()

    resolution = arguments.resolution
    try:
        mesh = meshing.trunk(int(resolution) if resolution.isdigit() else resolution)
    except meshing.MeshError as error:
        parser.error(str(error))
    path = arguments.output or Path(f"trunk_{resolution}.vtu")
    meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]).write(path)

    ratio, angle = meshing.radius_ratio(mesh.nodes, mesh.tets), meshing.min_dihedral(mesh.nodes, mesh.tets)
    print(f"{path}: {len(mesh.nodes)} nodes, {len(mesh.tets)} tetrahedra, {mesh.volume * 1e9:.0f} mm^3")
    print(f"worst radius ratio {ratio.min():.3f}, worst dihedral angle {angle.min():.1f} degrees")


if __name__ == "__main__":
    main()
