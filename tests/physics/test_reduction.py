"""Reduced bodies: equal to the full model with all modes, modes from motion, elements that stand for all, files."""

import json
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
import torch

import softwarp as sw
from softwarp import meshing, reduction
from softwarp.reduction import packing, training
from softwarp.reduction.basis import orthonormal
from tests.reduction_cases import AIR, BASE, CLAMPED, SLAB, every_node, reduced_by, run, scene, smooth_modes

RIGID = {"none": 0, "translations": 3, "motions": 6}


def simulation(builder, worlds=1, precision="float64", **options):
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.01, **options)


def both(given, worlds=1, precision="float64", options=None, **parts):
    """The full and the reduced model of a scene."""
    builders = [scene(**parts) for _ in range(2)]
    builders[1].reduce(0, given)
    return [simulation(builder, worlds, precision, **(options or {})) for builder in builders]


CASES = {
    "chamber, cable": ({"held": True, "contact": False}, "float64", 1, {}),
    "contact": ({"held": False, "contact": True}, "float64", 1, {}),
    "one world": ({"held": False, "contact": True}, "float32", 1, {}),
    "lanes": ({"held": False, "contact": True}, "float32", 8, {}),
    "stored law": ({"held": True, "contact": True, "law": sw.NeoHookean(1e5, 0.3)}, "float64", 1, {}),
    "stored law, lanes": ({"held": True, "contact": True, "law": sw.NeoHookean(1e5, 0.3)}, "float32", 8, {}),
    "second order": ({"held": False, "contact": True}, "float64", 1, {"integrator": "bdf2"}),
    "no damping": ({"held": True, "contact": False}, "float64", 1, {"integrator": "trapezoidal"}),
    "Newton": (
        {"held": True, "contact": False},
        "float64",
        1,
        {"newton_iterations": 6, "newton_tolerance": 1e-12, "pressure_tangent": False},
    ),
}


SLOW = {"stored law, lanes", "no damping", "Newton"}  # others have each of their parts


@pytest.mark.parametrize("case", [pytest.param(case, marks=pytest.mark.slow if case in SLOW else ()) for case in CASES])
def test_all_modes_give_the_full_model(case):
    """As many modes as unknowns: 20 steps of both models agree to rounding, with every part that may act on a body."""
    parts, precision, worlds, options = CASES[case]
    full, small = both(reduced_by(every_node(parts["held"])), worlds, precision, options, **parts)
    for sim in (full, small):
        run(sim, 20)
    tolerance = 2e-10 if precision == "float64" else 3e-7
    assert float((full.node_x - full.node_x.new_tensor(SLAB.nodes)).abs().max()) > 1e-3
    torch.testing.assert_close(small.node_x, full.node_x, rtol=0.0, atol=tolerance)
    torch.testing.assert_close(small.marker_v, full.marker_v, rtol=0.0, atol=1e3 * tolerance)
    torch.testing.assert_close(small.cavity_pressure, full.cavity_pressure, rtol=2e-5, atol=1e-6)
    torch.testing.assert_close(small.cable_tension, full.cable_tension, rtol=1e-4, atol=1e-9)
    torch.testing.assert_close(small.mass, full.mass)
    if parts["contact"]:
        assert torch.equal(small.contact_count, full.contact_count)
        assert int(full.contact_count.min()) > 0


def test_few_modes_are_galerkins_projection():
    """One step of eleven modes from rest solves Phi' A Phi v = h Phi' f with the matrices of the full model."""
    modes, h = smooth_modes(held=True), 0.01
    full, small = both(reduced_by(modes), held=True, contact=False, lone=True)
    K, M = full.stiffness_matrix(), full.mass_matrix()
    basis = modes.reshape(len(modes), -1).T
    A = (1.0 + h * 0.1) * M + h * (h + 0.01) * K
    weight = (full.mass[0].numpy()[:, None] * np.array([0.0, 0.0, -9.81])).ravel()
    v = np.linalg.solve(basis.T @ (A @ basis), h * basis.T @ weight)
    small.step()
    np.testing.assert_allclose(small.mode_v[0, :11].numpy(), v, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(small.node_x[0].numpy(), SLAB.nodes + h * (basis @ v).reshape(-1, 3), atol=1e-14)
    assert float(small.mode_q[0, 11:].abs().max()) == 0.0  # what fills the last block of three rests


@pytest.mark.parametrize(
    "law", [sw.Corotational(1e5, 0.3), sw.Corotational(1e5, 0.3, method="large"), sw.NeoHookean(1e5, 0.3)]
)
def test_weights_scale_elements(law):
    """Elements that count twice are twice as stiff, also where a guard compares their volume with that at rest."""
    modes = smooth_modes(held=True)
    sims = []
    for weight in (1.0, 2.0):
        builder = scene(held=True, contact=False, law=law, lone=True)
        weights = {"tet_weight": np.full(len(SLAB.tets), weight), "base_weight": np.full(len(BASE), weight)}
        given = reduced_by(modes, **weights)
        builder.reduce(0, given)
        sims.append(simulation(builder))
    sims[0].params.youngs.mul_(2.0)
    sims[0].params.membrane_youngs.mul_(2.0)
    for sim in sims:
        for _ in range(10):
            sim.step()
    torch.testing.assert_close(sims[0].node_x, sims[1].node_x, rtol=0.0, atol=1e-12)


def moved(count=40, seed=0):
    """States of a body: translations, a turn and some noise."""
    draws = np.random.default_rng(seed)
    x = SLAB.nodes - SLAB.nodes.mean(axis=0)
    states = draws.normal(size=(count, 1, 3)) * 0.01 + np.einsum(
        "sij,nj->sni", draws.normal(size=(count, 3, 3)) * 0.05, x
    )
    return states + 1e-4 * draws.normal(size=states.shape)


@pytest.mark.parametrize("rigid", RIGID)
def test_modes_are_orthonormal_in_mass(rigid):
    """To 1e-12, rigid motions among them exactly; singular values say what is left out."""
    mass = np.random.default_rng(1).uniform(0.5, 1.5, len(SLAB.nodes))
    states = moved()
    basis = reduction.pod(states, mass, SLAB.nodes, count=7, rigid=rigid)
    flat = basis.modes.reshape(len(basis.modes), -1)
    gram = (flat * np.repeat(mass, 3)) @ flat.T / mass.sum()
    assert len(flat) == 7 + RIGID[rigid] == 7 + basis.rigid
    np.testing.assert_allclose(gram, np.eye(len(flat)), atol=1e-12)

    def distance(u):
        q = (flat * np.repeat(mass, 3)) @ u.ravel() / mass.sum()
        left = u.ravel() - flat.T @ q
        return np.sqrt((left**2 * np.repeat(mass, 3)).sum() / mass.sum())

    if rigid != "none":
        assert distance(np.tile([0.3, -0.2, 0.1], (len(SLAB.nodes), 1))) < 1e-14
    if rigid == "motions":
        assert distance(np.cross([0.3, -0.2, 0.1], SLAB.nodes)) < 1e-14
    left = np.sqrt(sum(distance(u) ** 2 for u in states))
    assert left == pytest.approx(np.sqrt((basis.singular_values[7:] ** 2).sum()), rel=1e-9)
    assert basis.missing == pytest.approx(left / np.sqrt((basis.singular_values**2).sum()), rel=1e-9)
    fewest = reduction.pod(states, mass, SLAB.nodes, tolerance=0.05, rigid=rigid)
    assert fewest.missing <= 0.05
    one_less = reduction.pod(states, mass, SLAB.nodes, count=len(fewest.modes) - fewest.rigid - 1, rigid=rigid)
    assert one_less.missing > 0.05


def test_modes_by_another_length():
    """Modes leave out least in the lengths that they are chosen by, less than those by mass, orthonormal in mass."""
    draws = np.random.default_rng(5)
    mass, states = draws.uniform(0.5, 1.5, len(SLAB.nodes)), moved()
    root = scipy.sparse.random_array((3 * len(mass), 3 * len(mass)), density=0.02, rng=draws)
    metric = (root @ root.T + scipy.sparse.diags_array(10.0 ** draws.uniform(0.0, 4.0, 3 * len(mass)))).tocsr()
    metric = 0.5 * (metric + metric.T)
    left = {}
    for name, given in {"mass": None, "metric": metric}.items():
        basis = reduction.pod(states, mass, SLAB.nodes, count=6, metric=given)
        flat = basis.modes.reshape(6, -1)
        np.testing.assert_allclose((flat * np.repeat(mass, 3)) @ flat.T / mass.sum(), np.eye(6), atol=1e-12)
        u = states.reshape(len(states), -1).T
        apart = u - flat.T @ np.linalg.solve(flat @ (metric @ flat.T), flat @ (metric @ u))
        left[name] = np.sqrt((apart * (metric @ apart)).sum())
    assert left["metric"] == pytest.approx(np.sqrt((basis.singular_values[6:] ** 2).sum()), rel=1e-6)
    assert left["metric"] < 0.99 * left["mass"]
    with pytest.raises(ValueError, match="norm must be one of step, mass"):
        reduction.train(simulation(scene(held=True, contact=False)), reduction.Motion(SLAB.nodes[None]), norm="energy")


def test_sampling_finds_few_elements():
    """Weights are at least 0, sums within the tolerance; a tiny tolerance gives the forces of all elements."""
    draws = np.random.default_rng(0)
    G = np.abs(draws.normal(size=(30, 8))) @ np.abs(draws.normal(size=(8, 400))) + 0.01 * draws.normal(size=(30, 400))
    whole = G.sum(axis=1)
    counts = []
    for tolerance in (0.1, 0.01, 1e-10):
        found = reduction.sample_elements(G, tolerance)
        assert (found.weight >= 0.0).all()
        assert np.linalg.norm(G @ found.weight - whole) <= tolerance * np.linalg.norm(whole)
        assert found.residual <= tolerance
        counts.append(found.count)
    assert counts[0] < counts[1] <= counts[2] <= 31
    with pytest.raises(ValueError, match="no element has a force"):
        reduction.sample_elements(np.zeros((3, 4)), 0.1)
    with pytest.raises(ValueError, match="tolerance"):
        reduction.sample_elements(G, float("nan"))


@pytest.fixture(scope="module")
def trained():
    """Motion of the held slab, and what reduces it: with all elements, and with few."""
    sim = simulation(scene(held=True, contact=False), 16, "float32")
    air = float(sim.cavity_volume[0, 0])
    ranges = {"cables": {"cable": (0.0, 0.004)}, "cavities": {"air": (air, 2.0 * air)}}
    motion = reduction.record(sim, reduction.sweep(sim, **ranges, hold=40), 240, every=8)
    exact = simulation(scene(held=True, contact=False), 8)
    before = exact.node_x.clone()
    small = reduction.train(exact, motion, tolerance=2e-4, element_tolerance=0.01, membrane_tolerance=0.01)
    assert torch.equal(exact.node_x, before)
    return motion, small, ranges


def test_mixed_rows_keep_lengths():
    """Forces in fewer rows than states have: lengths and products of columns stay.

    The error of a product is that of as many draws as there are mixed rows, 1 / sqrt(3000) = 1.8 %, of its vectors.
    """
    draws = np.random.default_rng(5)
    rows = draws.normal(size=(9_000, 6)) * np.geomspace(1.0, 1e-3, 9_000)[:, None] ** draws.uniform(0.0, 1.0, 6)
    mixing, whole = training._Mixing(len(rows)), np.zeros((training.MIXED_ROWS, 6))
    for first in range(0, len(rows), 90):
        mixing.add(rows[first : first + 90], first, whole)
    exact, mixed = rows.T @ rows, whole.T @ whole
    size = np.sqrt(np.diag(exact))
    assert np.abs((mixed - exact) / np.outer(size, size)).max() < 4.0 / np.sqrt(training.MIXED_ROWS)
    at_once = np.zeros_like(whole)
    mixing.add(rows, 0, at_once)
    np.testing.assert_allclose(at_once, whole, rtol=0.0, atol=1e-12)


def test_training_holds_out_of_sample(trained):
    """Commands that it has not seen: 1 % of the way with all elements, 8 % with a quarter (0.1 %, 4 %)."""
    _, small, ranges = trained
    for given, limit in ((small.everything(), 0.01), (small, 0.08)):
        full, reduced = both(given, 8, "float32", held=True, contact=False)
        drives = [reduction.sweep(sim, **ranges, hold=40, seed=7) for sim in (full, reduced)]
        found = reduction.deviation(full, reduced, *drives, 120)
        assert float(found.mean[-1]) <= limit * float(found.travel[-1])
        assert found.relative <= limit
        assert bool((reduced.status == sw.Status.OK).all())
    tets, triangles = small.singles
    assert 0 < tets < 0.45 * len(SLAB.tets)
    assert triangles > 0
    assert small.report["unseen_error"] < 0.01 * small.report["unseen_motion"]


def test_reduced_energy_does_not_grow(trained):
    """Without damping the sampled elements, which have an energy, ring on for 100 steps and gain none."""
    _, small, _ = trained
    builder = scene(held=True, contact=False, lone=True)
    builder.bodies[0].rayleigh = (0.0, 0.0)
    builder.reduce(0, small)
    sim = sw.Simulation(
        builder.finalize(1, precision="float64"), dt=0.002, integrator="trapezoidal", newton_iterations=6
    )
    sim.params.gravity.zero_()
    sim.mode_v[0, 0] = 0.05
    sim.refresh()
    start = float(sim.kinetic_energy() + sim.elastic_energy())
    assert start == pytest.approx(0.5 * float(sim.mass.sum()) * 0.05**2, rel=1e-9)  # that of one orthonormal mode
    energies = []
    for _ in range(100):
        sim.step()
        energies.append(float(sim.kinetic_energy() + sim.elastic_energy()))
    assert 0.9 * start < min(energies) and max(energies) < 1.02 * start


def test_file_is_read_as_written_or_refused(trained, tmp_path):
    """Every number; damaged, foreign and newer files say so."""
    _, small, _ = trained
    path = tmp_path / "slab.npz"
    small.save(path)
    again = reduction.Reduction.load(path)
    for name in ("nodes", "tets", "modes", "singular_values", "tet_weight"):
        np.testing.assert_array_equal(getattr(again, name), getattr(small, name))
    np.testing.assert_array_equal(again.membrane_weight["base"], small.membrane_weight["base"])
    assert (again.name, again.rigid, again.report["states"]) == ("slab", 0, small.report["states"])
    with pytest.raises(reduction.ReductionFileError, match="no such file"):
        reduction.Reduction.load(tmp_path / "other.npz")
    data = path.read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    np.savez(tmp_path / "foreign.npz", a=np.ones(3))
    with np.load(path) as held:
        np.savez(tmp_path / "spoilt.npz", **{**held, "singular_values": np.full(3, np.nan)})
    newer = np.frombuffer(json.dumps({"format": "softwarp.reduction", "version": 99}).encode(), dtype=np.uint8)
    np.savez(tmp_path / "newer.npz", about=newer)
    for name, told in (
        ("cut", "damaged"),
        ("foreign", "damaged"),
        ("spoilt", "singular_values"),
        ("newer", "version 99"),
    ):
        with pytest.raises(reduction.ReductionFileError, match=told):
            reduction.Reduction.load(tmp_path / f"{name}.npz")


@pytest.mark.parametrize("old", [False, True])
@pytest.mark.parametrize("compact", [False, True])
def test_file_of_which_something_was_cut_off_is_refused(compact, old, tmp_path):
    """A mode, its direction or size, a weight, a count: by a digest, and in files of before it by what they tell."""
    rest = SLAB.nodes - (0.0, 0.015, 0.0)
    modes = np.random.default_rng(0).normal(size=(4, *rest.shape))
    modes = orthonormal(modes.reshape(4, -1)).reshape(modes.shape) * np.sqrt(len(rest))
    share, report = np.full(len(rest), 1.0 / len(rest)), {"amplitudes": [1e-3] * 4}
    small = replace(reduced_by(modes), nodes=rest, share=share, report=report)
    path, mesh = tmp_path / "slab.npz", meshing.SolidMesh(rest, SLAB.tets, "slab")
    small.save(path, compact=compact)
    with np.load(path) as file:
        held = dict(file)
    about = json.loads(held["about"].tobytes())
    if old:
        about.pop("digest")

    def written(told=None, **arrays):
        text = np.frombuffer(json.dumps({**about, **(told or {})}).encode(), dtype=np.uint8)
        np.savez(path, **{**held, "about": text, **arrays})
        return lambda: reduction.Reduction.load(path, mesh)

    np.testing.assert_allclose(written()().modes, modes, atol=2e-4)
    damages = [{"told": {"rigid": 7}}, {"told": {"rigid": -1}}, {"told": {"version": 0}}, {"told": {"name": ""}}]
    damages += [{"share": 2.0 * share}, {"told": {"report": {"amplitudes": [1e-3] * 3}}}]
    if not compact:
        damages += [{"modes": modes[:-1]}, {"modes": modes[1:]}, {"modes": modes * 2.0}, {"modes": modes[[0, 1, 2, 2]]}]
    if not old:
        damages += [{"tet_weight": 2.0 * small.tet_weight}, {"singular_values": small.singular_values[:-1]}]
    for damage in damages:
        with pytest.raises(reduction.ReductionFileError, match="damaged"):
            written(**damage)()


def test_compact_file(trained, tmp_path):
    """Small; modes to 0.1 um of motion and orthonormal in mass; only with the mesh that it was made for."""
    _, small, _ = trained
    path, whole = tmp_path / "compact.npz", tmp_path / "whole.npz"
    small.save(path, compact=True)
    small.save(whole)
    assert path.stat().st_size < 0.3 * whole.stat().st_size
    again = reduction.Reduction.load(path, SLAB)
    sizes = np.array(small.report["amplitudes"])
    assert (np.abs(again.modes - small.modes).max(axis=(1, 2)) * sizes).max() < 1e-7
    flat = again.modes.reshape(len(sizes), -1) * np.sqrt(np.repeat(again.share, 3))
    np.testing.assert_allclose(flat @ flat.T, np.eye(len(sizes)), atol=1e-12)
    coarse = tmp_path / "coarse.npz"
    small.save(coarse, compact=True, resolution=1e-6)
    rounded = reduction.Reduction.load(coarse, SLAB)
    assert coarse.stat().st_size < 0.9 * path.stat().st_size
    assert 1e-7 < (np.abs(rounded.modes - small.modes).max(axis=(1, 2)) * sizes).max() < 1e-6
    with pytest.raises(ValueError, match="resolution must be"):
        small.save(coarse, compact=True, resolution=0.0)
    assert reduction.read_about(path)["name"] == again.name == "slab"
    np.testing.assert_array_equal(again.tet_weight, small.tet_weight)
    with pytest.raises(reduction.ReductionFileError, match="does not hold the mesh of body 'slab'"):
        reduction.Reduction.load(path)
    moved = meshing.SolidMesh(SLAB.nodes + (1e-6, 0.0, 0.0), SLAB.tets, "moved")
    turned = meshing.SolidMesh(SLAB.nodes, SLAB.tets[::-1].copy(), "turned")
    for other in (moved, turned, meshing.box((0.06, 0.03, 0.012), (5, 3, 3))):
        with pytest.raises(reduction.ReductionFileError, match="belongs to another mesh of body 'slab'"):
            reduction.Reduction.load(path, other)
    with pytest.raises(ValueError, match="does not know the nodes' masses"):
        replace(small, share=None).save(path, compact=True)


def test_compact_file_of_symmetric_modes(tmp_path):
    """Of modes that a mirror leaves or turns round one half is kept, and comes back whole."""
    rest = SLAB.nodes - (0.0, 0.015, 0.0)
    image, flip = packing.images(rest), np.array([1.0, -1.0, 1.0])
    modes = np.random.default_rng(0).normal(size=(4, *rest.shape))
    modes = modes + modes[:, image] * flip * np.array([1.0, 1.0, -1.0, 1.0])[:, None, None]
    modes = orthonormal(modes.reshape(4, -1)).reshape(modes.shape) * np.sqrt(len(rest))
    share = np.full(len(rest), 1.0 / len(rest))
    sizes = {"amplitudes": [1e-3] * 4}
    small = replace(reduced_by(modes), nodes=rest, share=share, report=sizes, rigid=0)
    small.save(tmp_path / "half.npz", compact=True)
    with np.load(tmp_path / "half.npz") as file:
        assert file["parity"].tolist() == [1, 1, -1, 1] and file["planes"].shape[-1] < 0.7 * len(rest)
    again = reduction.Reduction.load(tmp_path / "half.npz", meshing.SolidMesh(rest, SLAB.tets, "slab"))
    np.testing.assert_allclose(again.modes, modes, atol=2e-4)


def test_modes_of_mirrored_halves():
    """Of even and odd halves of any motion every mode is its own mirror image, or that turned round."""
    rest = SLAB.nodes - (0.0, 0.015, 0.0)
    image, flip = packing.images(rest), np.array([1.0, -1.0, 1.0])
    motion = np.random.default_rng(0).normal(size=(12, *rest.shape))
    mass = np.full(len(rest), 1e-3)

    def signs(displacements):
        modes = reduction.pod(displacements, mass, rest, count=10).modes
        mirrored = modes[:, image] * flip
        return np.einsum("knc,knc->k", mirrored, modes) / np.einsum("knc,knc->k", modes, modes)

    found = signs(packing.halves(motion, rest))
    np.testing.assert_allclose(np.abs(found), 1.0, atol=1e-9)
    assert set(np.sign(found)) == {1.0, -1.0}
    assert np.abs(signs(motion)).max() < 0.9
    even, odd = np.split(packing.halves(motion, rest), 2)
    np.testing.assert_allclose(even + odd, motion, atol=1e-15)


def held_moves(builder):
    builder.reduce(0, reduced_by(smooth_modes(held=False)))
    return builder.finalize()


def attached(builder):
    arm = builder.add_rigid(sw.Box((0.01, 0.01, 0.01)), mass=0.1, pose=(0.1, 0.0, 0.0))
    builder.attach(0, [len(SLAB.nodes) - 1], arm)
    builder.reduce(0, reduced_by(smooth_modes(held=True)))
    return builder.finalize()


def locked(builder):
    builder.fix(0, nodes=[len(SLAB.nodes) - 1], axes="z")
    builder.reduce(0, reduced_by(smooth_modes(held=True)))
    return builder.finalize()


BAD = {
    "held nodes": (held_moves, "modes move node"),
    "another mesh": (
        lambda b: b.reduce(0, replace(reduced_by(smooth_modes(True)), nodes=SLAB.nodes * 1.1)),
        "another mesh",
    ),
    "twice": (lambda b: [b.reduce(0, reduced_by(smooth_modes(True))) for _ in range(2)], "reduced already"),
    "no element": (
        lambda b: b.reduce(0, reduced_by(smooth_modes(True), tet_weight=np.zeros(len(SLAB.tets)))),
        "nothing resists",
    ),
    "negative weights": (
        lambda b: b.reduce(0, reduced_by(smooth_modes(True), tet_weight=-np.ones(len(SLAB.tets)))),
        "from 0 on",
    ),
    "membranes": (
        lambda b: [b.reduce(0, replace(reduced_by(smooth_modes(True)), membrane_weight={})), b.finalize()],
        "membranes",
    ),
    "attached": (attached, "attached to frames"),
    "locked": (locked, "single axes"),
}


@pytest.mark.parametrize("case", BAD)
def test_impossible_reductions_are_refused(case):
    """With the body's name and what is wrong."""
    act, told = BAD[case]
    with pytest.raises(ValueError, match=told) as caught:
        act(scene(held=True, contact=False))
    assert "slab" in str(caught.value)


def test_modes_that_hold_a_free_body_are_refused():
    """In a scene without the supports of the training it would hang in the air."""
    builder = scene(held=False, contact=False)
    builder.reduce(0, reduced_by(smooth_modes(held=True)))
    with pytest.raises(ValueError, match=r"body 'slab': its modes hold .* nothing holds them in the scene; fix them"):
        builder.finalize()


def test_an_effort_that_never_changes_moves_nothing():
    """A chamber at a constant pressure, and a cable at a constant tension, have not moved, though the body has."""
    builder = sw.ModelBuilder()
    body = builder.add_tets(SLAB, material=sw.Corotational(1e5, 0.3), density=1e3, rayleigh=(1.0, 0.01), name="slab")
    builder.fix(body, nodes=np.flatnonzero(CLAMPED))
    shell = meshing.compact(AIR.nodes + (0.01, 0.005, 0.003), AIR.surface())
    builder.add_cavity(body, *shell, control="pressure", name="air")
    builder.add_cable(body, [(x, 0.015, 0.009) for x in (0.06, 0.03, 0.0)], control="force", name="cable")
    sim = simulation(builder)
    sim.control.cable_tension[:] = 0.1
    assert reduction.record(sim, lambda sim, step: None, 4, every=2).travel == {"air": 0.0, "cable": 0.0}
    told = reduction.record(sim, lambda sim, step: sim.control.cavity_pressure.fill_(100.0 * step), 4, every=2)
    assert told.travel["air"] > 0.0 and told.travel["cable"] == 0.0
    with pytest.raises(ValueError, match="'cable' did not move in it"):
        reduction.train(sim, told)


def test_what_is_no_reduction_is_refused():
    """A file's name is not read: the message says what reads it."""
    for wrong in ("body.npz", None, 3):
        with pytest.raises(TypeError, match=r"body 'slab': reduction must be a Reduction.*Reduction\.load"):
            scene(held=True, contact=False).reduce(0, wrong)


def test_other_elements_and_relaxing_bodies_are_refused():
    """They cannot be reduced, and say so before anything else is looked at."""
    builder = sw.ModelBuilder()
    given = reduced_by(smooth_modes(True))
    for options, told in (({"element": "p2"}, "elements 'p2'"), ({"relaxation": (0.2, 0.1)}, "relaxation")):
        body = builder.add_tets(SLAB, material=sw.NeoHookean(1e5, 0.3), density=1e3, name=told.strip("'"), **options)
        with pytest.raises(ValueError, match=told):
            builder.reduce(body, given)


def test_training_refuses_motion_that_says_too_little(trained):
    """Still actuators, other scenes, motion without deformation, tolerances that are none."""
    motion, small, _ = trained
    assert len(repr(small)) < 120 and "of body 'slab'" in repr(small)
    sim = simulation(scene(held=True, contact=False), 2)
    with pytest.raises(ValueError, match="'air' did not move"):
        reduction.train(sim, replace(motion, travel={"cable": 0.004, "air": 0.0}))
    with pytest.raises(ValueError, match="record it with this scene"):
        reduction.train(sim, replace(motion, positions=motion.positions[:, 1:]))
    still = np.tile(SLAB.nodes.astype(np.float32), (10, 1, 1))
    with pytest.raises(ValueError, match="nothing moves"):
        reduction.train(sim, replace(motion, positions=still))
    with pytest.raises(ValueError, match="held, so that it cannot move rigidly"):
        reduction.train(sim, motion, rigid="translations")
    with pytest.raises(ValueError, match="tolerance"):
        reduction.train(sim, motion, tolerance=float("inf"))
    with pytest.raises(ValueError, match="modes"):
        reduction.train(sim, motion, modes=10**6)
    for name, wrong in (("states", 0), ("seed", -1), ("contact_modes", -1), ("mirrored", 1), ("still", ("other",))):
        with pytest.raises(ValueError, match=name):
            reduction.train(sim, motion, **{name: wrong})
    with pytest.raises(ValueError, match="no cable 'other'"):
        reduction.sweep(sim, cables={"other": (0.0, 1.0)})
    assert CLAMPED.any()
