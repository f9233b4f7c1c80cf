"""Write a finger, its cavities and the figurine to files: python assets/gripper/generate.py coarse folder."""

import argparse
from pathlib import Path

import meshio

from softwarp import meshing


def main() -> None:
    """Read the command line, generate, write."""
    parser = argparse.ArgumentParser(description="Write finger, cavities and figurine to files, in metres.")
    parser.add_argument("resolution", nargs="?", default="coarse", help="coarse, medium or fine")
    parser.add_argument("folder", nargs="?", type=Path, default=Path(), help="where to; default: the working folder")
    parser.add_argument("--kind", default="cavities", help="cavities or plain")
    arguments = parser.parse_args()

    try:
        finger = meshing.finger(arguments.resolution, arguments.kind)
    except meshing.MeshError as error:
        parser.error(str(error))
    mesh, name = finger.mesh, f"finger_{arguments.kind}_{arguments.resolution}"
    arguments.folder.mkdir(parents=True, exist_ok=True)
    solid = arguments.folder / f"{name}.vtu"
    meshio.Mesh(mesh.nodes, [("tetra", mesh.tets)]).write(solid)
    print(f"{solid}: {len(mesh.nodes)} nodes, {len(mesh.tets)} tetrahedra, {mesh.volume * 1e9:.0f} mm^3")
    for number, (vertices, triangles) in enumerate(finger.cavities, start=1):
        path = arguments.folder / f"{name}_cavity_{number}.stl"
        meshio.Mesh(vertices, [("triangle", triangles)]).write(path)
        air = meshing.surface_volume(vertices, triangles)
        print(f"{path}: {len(vertices)} vertices, {len(triangles)} triangles, {air * 1e9:.0f} mm^3 of air")
    figurine = meshing.figurine()
    path = arguments.folder / "figurine.stl"
    meshio.Mesh(figurine.nodes, [("triangle", figurine.triangles)]).write(path)
    print(f"{path}: {len(figurine.nodes)} vertices, {len(figurine.triangles)} triangles")

    ratio, angle = meshing.radius_ratio(mesh.nodes, mesh.tets), meshing.min_dihedral(mesh.nodes, mesh.tets)
    print(f"worst radius ratio of the finger {ratio.min():.3f}, worst dihedral angle {angle.min():.1f} degrees")


if __name__ == "__main__":
    main()
