"""Elements inside out: recorded, marked in pictures and in USD."""

import dataclasses

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.io import palette
from softwarp.io.colormap import srgb_to_linear
from softwarp.io.trajectory import Recorder, Trajectory
from softwarp.io.usd import export_usd
from softwarp.render import RayCaster, render_trajectory


def two_bodies(order):
    """Two worlds of a box beside a single tetrahedron; the second's fourth corner is pushed through its base."""
    builder = sw.ModelBuilder()
    builder.add_tets(meshing.box((0.1, 0.1, 0.1), (2, 2, 2)), material=sw.NeoHookean(1e5, 0.4), density=1e3)
    nodes = np.array([[0.2, 0.0, 0.0], [0.3, 0.0, 0.0], [0.2, 0.1, 0.0], [0.2, 0.0, 0.1]])
    mesh = (nodes, np.array([[0, 1, 2, 3]]))
    if order == 2:
        mesh = (meshing.elevate(*mesh),)
    builder.add_tets(*mesh, material=sw.NeoHookean(1e5, 0.4), density=1e3)
    sim = sw.Simulation(builder.finalize(num_worlds=2, device="cpu"), dt=0.01)
    x = sim.node_x.clone()
    corners = x[1, 27:].clone()
    corners[:, 2] *= -1.0
    x[1, 27:] = corners
    return sim, x


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_recording_marks_the_elements_inside_out_in_pictures_and_usd(order, tmp_path):
    Usd = pytest.importorskip("pxr.Usd")
    UsdGeom = pytest.importorskip("pxr.UsdGeom")
    sim, x = two_bodies(order)
    recorder = Recorder(sim, worlds=[1, 0])
    recorder.capture(time=0.0)
    sim.node_x.copy_(x)
    recorder.capture(time=0.1)
    film = Trajectory.load(recorder.finish().save(tmp_path / "film.npz"))
    assert film.inverted_x.shape == (2, 2, 1, 3)
    assert np.isnan(film.inverted_x[0]).all() and np.isnan(film.inverted_x[1, 1]).all()
    np.testing.assert_allclose(film.inverted_x[1, 0, 0], [0.225, 0.025, -0.025], atol=1e-7)

    shown, hidden = (render_trajectory(film, width=320, height=240, inversions=mark) for mark in (True, False))
    differs = (shown != hidden).any(axis=-1)
    assert not differs[0].any() and 15 < differs[1, :, :320].sum() < 300 and not differs[1, :, 320:].any()
    caster = RayCaster.for_model(sim.model, width=320, height=240)
    live = (caster.draw(sim, inversions=True) != caster.draw(sim)).any(axis=(1, 2, 3))
    assert live.tolist() == [False, True]

    stage = Usd.Stage.Open(str(export_usd(film, tmp_path / "film.usda")))
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/world_1/inverted"))
    assert [len(points.GetPointsAttr().Get(code)) for code in (0.0, 1.0)] == [0, 1]
    np.testing.assert_allclose(points.GetPointsAttr().Get(1.0)[0], film.inverted_x[1, 0, 0])
    color = points.GetDisplayColorAttr().Get()[0]
    np.testing.assert_allclose(color, srgb_to_linear(np.array(palette.INVERTED)), atol=1e-6)
    assert len(UsdGeom.Points(stage.GetPrimAtPath("/World/world_0/inverted")).GetPointsAttr().Get(1.0)) == 0
    bare = Usd.Stage.Open(str(export_usd(film, tmp_path / "bare.usda", inversions=False)))
    assert not bare.GetPrimAtPath("/World/world_1/inverted")


def test_recordings_without_marks_are_drawn():
    sim, _ = two_bodies(1)
    recorder = Recorder(sim)
    recorder.capture()
    film = recorder.finish()
    assert film.inverted_x.shape == (1, 1, 0, 3)
    old = dataclasses.replace(film, inverted_x=None)
    np.testing.assert_array_equal(
        render_trajectory(film, width=32, height=24), render_trajectory(old, width=32, height=24)
    )
