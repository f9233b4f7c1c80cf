"""``softwarp reduce``: a file, a picture and a report; the robot that the file makes; what it refuses."""

import contextlib
import io

import pytest
import torch

import softwarp as sw
from experiments import early, reduce
from softwarp.control import InverseController, PointEffector
from softwarp.reduction import Reduction

SMALL = ["env=diamond", "num_worlds=4", "actions=4", "states=12", "element_tolerance=0.2", "modes=8", "compare=2"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The file of a quick reduction; beside it what was printed."""
    path = tmp_path_factory.mktemp("reduce") / "diamond.npz"
    with contextlib.redirect_stdout(io.StringIO()) as told:
        assert reduce.main(SMALL, {"out": str(path)}) == 0
    path.with_suffix(".txt").write_text(told.getvalue(), encoding="utf-8")
    return path


def test_file_report_and_picture(written):
    """Eight modes and a part of the tets; the report names them, errors and speed."""
    told = written.with_suffix(".txt").read_text(encoding="utf-8")
    for part in ("8 modes (0 rigid)", "of 5760 tets", "apart", "times faster"):
        assert part in told
    assert written.with_suffix(".png").stat().st_size > 20_000
    made = Reduction.load(written)
    assert len(made.modes) == 8
    assert (made.tet_weight > 0.0).sum() < 1000


@pytest.mark.slow
def test_the_same_seed_gives_the_same_basis(written):
    """Bits, from drawing the motions to choosing the modes."""
    again = written.with_name("again.npz")
    assert reduce.main(SMALL, {"out": str(again)}) == 0
    first, second = Reduction.load(written), Reduction.load(again)
    assert torch.equal(torch.as_tensor(first.modes), torch.as_tensor(second.modes))


def test_environment_runs_reduced(written):
    """Views of all nodes, episodes that start at rest, snapshots in bits; other meshes are refused."""
    env = sw.make("Diamond", num_worlds=2, seed=1, reduced=str(written))
    assert env.sim.model.mode_count == 9
    state = env.reset()
    for _ in range(2):
        state = env.step(state.set("action", env.action_spec.rand()))["next"].exclude("reward")
    assert not bool(state["terminated"].any())
    assert float((env.sim.node_x - env.sim.node_x[:1]).abs().max()) > 0.0
    saved, command = env.snapshot(), env.action_spec.rand()
    ends = []
    for _ in range(2):
        env.restore(saved)
        env.step(state.set("action", command))
        ends.append(env.sim.node_x.clone())
    assert torch.equal(*ends)
    with pytest.raises(ValueError, match=r"belongs to (another|a) mesh"):
        sw.make("Diamond", num_worlds=1, mesh="coarse", reduced=str(written))
    with pytest.raises(ValueError, match="settle does not know reduced bodies"):
        InverseController(env.sim, [PointEffector((0,))], settle=1e-3)
    with pytest.raises(ValueError, match="'diamond', which the scene lacks"):
        sw.make("Trunk", num_worlds=1, reduced=str(written))


def test_mistakes_are_told_before_work(tmp_path):
    """Endings, bodies, ranges."""
    with pytest.raises(ValueError, match=r"need the ending \.npz"):
        early.reduce(["env=diamond"], {"out": str(tmp_path / "a.txt")})
    with pytest.raises(ValueError, match="modes"):
        early.reduce(["env=diamond", "modes=-1"], {"out": str(tmp_path / "a.npz")})
    with pytest.raises(ValueError, match="body=leg"):
        reduce.main([*SMALL, "body=leg"], {"out": str(tmp_path / "a.npz")})


def test_hexahedra_are_told_before_motion_is_recorded():
    """Alone, or by their name; beside a body of tetrahedra that one is chosen."""
    builder = sw.ModelBuilder()
    material = sw.Corotational(1e5, 0.3)
    builder.add_hexes(sw.meshing.brick((0.1, 0.1, 0.1), (1, 1, 1)), material=material, density=1e3, name="slab")
    sim = sw.Simulation(builder.finalize())
    for name in ("", "slab"):
        with pytest.raises(ValueError, match=r"slab.* has hexahedra, which cannot be reduced yet"):
            reduce._body(sim, name)
    cube = builder.add_tets(sw.meshing.box((0.1, 0.1, 0.1), (1, 1, 1)), material=material, density=1e3)
    assert reduce._body(sw.Simulation(builder.finalize()), "") == cube
