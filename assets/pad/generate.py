"""Write the pad and its chamber to files for other programs: python assets/pad/generate.py coarse pad.vtu air.stl."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write the generated pad and its chamber to files, in metres.")
    parser.add_argument("resolution", nargs="?", default="coarse", help="coarse, medium or fine")
    parser.add_argument("output", nargs="?", type=Path, help="file of the solid; default: pad_<resolution>.vtu")
    parser.add_argument(
        "chamber", nargs="?", type=Path, help="file of the chamber; default: pad_<resolution>_chamber.stl"
    )
    arguments = parser.parse_args()

    resolution = arguments.resolution
    try:
        pad = meshing.pad(resolution)
    except meshing.MeshError as error:
        parser.error(str(error))
    mesh, chamber = pad.mesh, pad.cavity_triangles
    solid_file = arguments.output or Path(f"pad_{resolution}.vtu")
    chamber_file = arguments.chamber or Path(f"pad_{resolution}_chamber.stl")
    meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]).write(solid_file)
    meshio.Mesh(pad.cavity_vertices, [("triangle", chamber)]).write(chamber_file)

    ratio, angle = meshing.radius_ratio(mesh.nodes, mesh.tets), meshing.min_dihedral(mesh.nodes, mesh.tets)
    air = meshing.surface_volume(pad.cavity_vertices, chamber)
    print(f"{solid_file}: {len(mesh.nodes)} nodes, {len(mesh.tets)} tetrahedra, {mesh.volume * 1e6:.2f} cm^3")
    print(f"{chamber_file}: {len(pad.cavity_vertices)} vertices, {len(chamber)} triangles, {air * 1e6:.2f} cm^3 of air")
    print(f"worst radius ratio {ratio.min():.3f}, worst dihedral angle {angle.min():.1f} degrees")


if __name__ == "__main__":
    main()
