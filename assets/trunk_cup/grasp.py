"""Let the trunk wrap itself round the cup and lift it; writes the state that the TrunkCup environment starts in.

    python assets/trunk_cup/grasp.py --out softwarp/envs/trunk_cup_grasp.npz --picture grasp.png

Four stages, on the coarse meshes with the default options. The cup first stands on a table without friction, which
holds the edge of its bottom at its height, and there is no gravity.

1. The cables on the side of the cup are pulled, until the trunk lies round it.
2. All cables are taken up to where they hang now and a little more, which stiffens the trunk; those on the side of the
   cup squeeze it.
3. Gravity rises to its value.
4. The table is taken away. Trunk and cup sag, and come to rest.

The state is refused unless the cup is at rest, hangs on the trunk alone, and the trunk reaches round more than half of
it. Takes about a minute.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

import softwarp as sw
from softwarp.envs.options.trunk_cup import TrunkCupSceneConfig
from softwarp.envs.scenes.trunk_cup import CUP_PLACE, TrunkCupScene, build_trunk_cup_scene
from softwarp.render import Camera, RayCaster

DT = 0.01  # s
CAPACITY = 160
PULL = (0.0, -0.040, 0.0, 0.044, 0.0, -0.020, 0.0, 0.014)  # m, stage 1: long cables +y, -x, -y, +x, then short ones
MORE = (0.005, 0.003, 0.001, 0.005, 0.004, 0.003, 0.002, 0.002)  # m, stage 2: beyond where cables hang
WRAP, TAKE_UP, LOAD, REST = 2.5, 1.0, 1.5, 8.0  # s, of the stages
STILL = 1.0e-4  # m/s


def build(config: TrunkCupSceneConfig, *, table: bool) -> tuple[sw.Simulation, TrunkCupScene]:
    """One world, with the bottom's edge held at its height or free."""
    builder = sw.ModelBuilder(gravity=config.gravity)
    scene = build_trunk_cup_scene(config, builder)
    if table:
        builder.fix(scene.cup, box=((-1.0, -1.0, -1.0), (1.0, CUP_PLACE[1] + 0.0025, 1.0)), axes="y")
    model = builder.finalize(1, contact_capacity=CAPACITY)
    return sw.Simulation(model, dt=DT, solver_path="scalar", threads=1), scene


def grasp(config: TrunkCupSceneConfig) -> tuple[sw.Simulation, TrunkCupScene]:
    """The wrapped state at rest."""
    sim, scene = build(config, table=True)
    gravity, pull = torch.tensor(config.gravity), torch.tensor(PULL)
    sim.params.gravity.zero_()
    for step in range(round(WRAP / DT)):
        sim.control.cable_displacement.copy_(pull * min(1.0, step * DT / (0.8 * WRAP)))
        sim.step()
    start = sim.cable_displacement[0].clone()
    for step in range(round((TAKE_UP + LOAD) / DT)):
        t = step * DT
        sim.control.cable_displacement.copy_(start + min(1.0, t / (0.8 * TAKE_UP)) * torch.tensor(MORE))
        sim.params.gravity.copy_(gravity * min(1.0, max(0.0, (t - TAKE_UP) / (0.8 * LOAD))))
        sim.step()
    free, _ = build(config, table=False)
    for name, view in sim.snapshot().arrays.items():  # the scenes differ in nothing else than the table
        group, _, key = name.partition(".")
        if group != "params" and view.numel():
            (free.control if group == "control" else free).__getattr__(key).copy_(view)
    free.refresh()
    for _ in range(round(REST / DT)):
        free.step()
    return free, scene


def check(sim: sw.Simulation, scene: TrunkCupScene, config: TrunkCupSceneConfig) -> None:
    """Refuse what is no grasp."""
    speed = float(sim.node_v.abs().max())
    force = sim.contact_force(scene.cup, scene.trunk.body)[0].numpy()
    weight = config.cup_mass * np.array(config.gravity)
    axis_point = sim.marker_x[0, 4:].mean(dim=0).numpy()
    loads = sim.contact_load[0].norm(dim=-1)
    touching = loads > 1.0e-3 * loads.max()
    around = (sim.contact_point[0, touching].numpy() - axis_point)[:, [0, 2]]
    angle = np.sort(np.arctan2(around[:, 1], around[:, 0]))
    gaps = np.diff(np.append(angle, angle[0] + 2.0 * np.pi))
    print(
        f"speed {speed:.1e} m/s, force {force} N for a weight of {-weight} N, squeezed with {float(loads.sum()):.2f} N"
    )
    print(
        f"{int(touching.sum())} of {int(sim.contact_count[0])} contacts loaded, {360 - np.degrees(gaps.max()):.0f} deg"
    )
    if speed > STILL or not np.allclose(force, -weight, atol=0.01 * np.linalg.norm(weight)) or gaps.max() > np.pi:
        raise SystemExit("this is no grasp: the cup moves, hangs on something else, or is not wrapped")


def main() -> None:
    """Grasp, check, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("softwarp/envs/trunk_cup_grasp.npz"))
    parser.add_argument("--picture", type=Path)
    args = parser.parse_args()
    config = TrunkCupSceneConfig()
    sim, scene = grasp(config)
    if args.picture:
        from PIL import Image

        camera = Camera(eye=(0.30, 0.16, 0.30), target=(0.03, -0.02, 0.03), up=(0.0, 1.0, 0.0), fov=31.0)
        caster = RayCaster.for_model(sim.model, width=480, height=360, camera=camera)
        Image.fromarray(caster.draw(sim, [0])[0]).save(args.picture)
    check(sim, scene, config)
    split = int(sim.model.body_node_start[scene.cup])
    trunk_x, cup_x = np.split(sim.node_x[0].numpy(), [split])
    np.savez_compressed(args.out, trunk_x=trunk_x, cup_x=cup_x, command=sim.control.cable_displacement[0].numpy())
    print(f"{args.out}: {args.out.stat().st_size} bytes")


if __name__ == "__main__":
    main()
