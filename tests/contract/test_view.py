"""``softwarp view`` and ``Viewer``: what browsers see is the simulation, and what users set reaches it."""

import shutil
import sys
import threading
import time

import gymnasium
import numpy as np
import pytest
import torch

import softwarp
from softwarp.policies.baselines.table import rule
from softwarp.render import Camera, RayCaster

viser = pytest.importorskip("viser", reason="the extra 'view' is not installed")

from softwarp.view import HAND, Viewer  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture
def viewer():
    """Two trunks, driven by their hand-written policy."""
    env = softwarp.make("Trunk", num_worlds=2, seed=0)
    with Viewer(env, {"scripted": rule(env, "Trunk")}, port=8210, speed=4.0) as made:
        yield made


def on_stage(viewer, name="soft"):
    """Vertices of a mesh as browsers have them, per world without its place on the stage."""
    x = viewer.stage.bodies[name].vertices.reshape(viewer.stage.count, -1, 3)
    return x - viewer.stage.offsets[:, None].astype(np.float32)


def test_meshes_follow_the_nodes(viewer):
    """Every picture holds the surface of every world where the simulation has it; nothing is made anew."""
    server, names = viewer._server, set(viewer.stage.bodies)
    viewer.run(1.0)
    kept = len(server._websock_server._broadcast_buffer.message_from_id)
    viewer.run(1.0)
    viewer.draw()
    surface = viewer.stage._solids.vertex_node
    np.testing.assert_allclose(on_stage(viewer), viewer.env.sim.node_x[:, surface].numpy(), atol=1e-6)
    assert viewer.actions > 5 and viewer.pictures > 10
    assert set(viewer.stage.bodies) == names
    assert len(server._websock_server._broadcast_buffer.message_from_id) <= kept + 20  # newest values alone are kept


def test_users_drive(viewer):
    """Sliders are actions, a reset begins the episode of its seed, a goal goes where it is dragged."""
    panel, env = viewer.panel, viewer.env
    panel._driver.value = HAND
    panel._sliders[0].value = 0.5
    assert panel.action()[:, 0].tolist() == [0.5, 0.5]
    panel._seed.value, panel.resets_asked = 7, 1
    panel._paused.value = True
    viewer.run(0.2)
    other = softwarp.make("Trunk", num_worlds=2, seed=7)
    other.set_seed(7)
    other.reset()
    torch.testing.assert_close(env.goal_points(), other.goal_points())
    place = np.array([0.01, 0.02, 0.1]) + viewer.stage.offsets[1]
    viewer._moved_goals[1] = tuple(place)
    viewer.run(0.1)
    torch.testing.assert_close(env.goal_points()[1], torch.tensor([0.01, 0.02, 0.1]))
    taken = viewer.actions
    panel._ask_step()
    viewer.run(0.3)
    assert viewer.actions == taken + 1  # and the pause holds


def test_pull(viewer):
    """A spring to the pointer bends the trunk that was taken hold of, and no other; let go, its force is gone."""
    viewer.panel._driver.value, viewer.panel._pull.value = HAND, 50.0
    viewer.run(0.3)
    sim = viewer.env.sim
    tip = int(sim.node_x[1, :, 2].abs().argmax())
    grip = sim.node_x[1, tip].numpy() + viewer.stage.offsets[1]
    viewer._pull = (grip, grip + np.array([0.05, 0.0, 0.0]))
    before = sim.node_x[:, tip].clone()
    viewer.run(0.5)
    moved = (sim.node_x[:, tip] - before).norm(dim=1)
    assert moved[1] > 0.002 and moved[0] < 0.2 * moved[1]
    assert float(sim.control.node_force[0].abs().max()) == 0.0
    viewer._pull = None
    viewer.run(0.2)
    assert float(sim.control.node_force.abs().max()) == 0.0


@pytest.mark.parametrize("name", ["Gripper", "BubbleMotion", "CartStem"])
def test_all_kinds_of_parts(name):
    """Rigid bodies, rods, chambers and contact forces are shown, with finite vertices."""
    env = softwarp.make(name, num_worlds=1, seed=0)
    with Viewer(env, {"scripted": rule(env, name)}, port=8230) as viewer:
        viewer.panel._chambers.value = viewer.panel._contacts.value = True
        viewer.run(1.0)
        for handle in viewer.stage.bodies.values():
            assert np.isfinite(handle.vertices).all() and np.ptp(handle.vertices, axis=0).max() > 0.0
        for handle, world, chamber in viewer.stage._chambers:
            there = viewer.stage._chamber_points(env.sim.node_x.numpy())
            there = there[world, viewer.stage.parts.cavity_points(chamber)]
            assert handle.visible and np.abs(handle.vertices - there).max() < 1e-2


def test_steps_that_are_watched_are_the_same():
    """A viewer changes nothing: the states of its environment are those of one that nobody watches."""
    states = []
    for watcher in (None, lambda: None):
        env = softwarp.make("Trunk", num_worlds=2, seed=3)
        td = env.reset()
        env.watcher = watcher
        policy = rule(env, "Trunk")
        for _ in range(3):
            td = env.step(policy(td))["next"]
        states.append(env.sim.node_x.clone())
    assert torch.equal(*states)


@pytest.mark.parametrize("worlds", [1, 2])
def test_human_render_mode(worlds, caplog):
    """Gymnasium's ``render_mode="human"`` shows what happens in real time, tells where, and is gone after ``close``."""
    if worlds == 1:
        env = gymnasium.make("softwarp/CartPole-v0", render_mode="human")
    else:
        env = gymnasium.make_vec("softwarp/CartPole-v0", num_envs=worlds, render_mode="human")
    own = env.unwrapped
    env.reset(seed=0)
    before = time.monotonic()
    for _ in range(10):
        env.step(env.action_space.sample())
    assert time.monotonic() - before > 8 * own.env.control_dt
    assert own._window.pictures > 3 and env.render() is None
    assert own._window.url in caplog.text
    env.close()
    assert own._window is None and own.env.watcher is None


def test_refusals(monkeypatch):
    """A value out of range and a missing viser are told."""
    env = softwarp.make("CartPole", num_worlds=1)
    with pytest.raises(ValueError, match="fps"):
        Viewer(env, fps=0.0)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"softwarp\[view\]"):
        Viewer(env)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here; apt install chromium")
def test_in_a_browser():
    """Two browsers connect without errors, show the robot's silhouette, and a slider moved there moves the robot."""
    playwright = pytest.importorskip("playwright.sync_api")
    env = softwarp.make("Trunk", num_worlds=1, seed=0)
    viewer = Viewer(env, {}, port=8250)
    viewer.panel._paused.value = True
    for handle in (*viewer.stage._goals, *viewer._handles):
        handle.visible = False
    errors, found = [], {}

    def browse():
        flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=flags)
            pages = [browser.new_page(viewport={"width": 900, "height": 700}) for _ in range(2)]
            for page in pages:
                page.on("pageerror", lambda error: errors.append(str(error)))
                page.on("console", lambda line: errors.append(line.text) if line.type == "error" else None)
                page.goto(viewer.url)
            pages[0].wait_for_selector("canvas", timeout=30000)
            until = time.monotonic() + 30.0
            while viewer.clients < 2 and time.monotonic() < until:
                pages[0].wait_for_timeout(200)
            found["clients"] = viewer.clients
            pages[0].wait_for_timeout(2000)
            client = next(iter(viewer._server.get_clients().values()))
            asked = threading.Thread(target=lambda: found.update(picture=client.get_render(240, 320)), daemon=True)
            asked.start()
            while asked.is_alive() and time.monotonic() < until + 30.0:
                pages[0].wait_for_timeout(100)
            found["camera"] = (client.camera.position, client.camera.look_at, client.camera.up_direction)
            found["fov"] = client.camera.fov
            field = pages[0].locator("input").nth(found_slider(pages[0]))
            field.fill("0.5")
            field.press("Enter")
            pages[0].wait_for_timeout(500)
            pages[0].close()  # one leaves, the other and the simulation go on
            pages[1].wait_for_timeout(300)
            found["value"] = viewer.panel.action()[0].tolist()
            browser.close()
        viewer.stop()

    with viewer:
        thread = threading.Thread(target=browse)
        thread.start()
        viewer.run(120.0)
        thread.join(10.0)
    assert not errors and found["clients"] == 2
    assert 0.5 in [round(value, 3) for value in found["value"]]
    camera = Camera(*(tuple(map(float, v)) for v in found["camera"]), float(np.degrees(found["fov"])))
    drawn = RayCaster.for_model(env.sim.model, width=320, height=240, camera=camera).draw(env.sim)[0]
    ours, theirs = (is_robot(picture) for picture in (drawn, found["picture"]))
    assert ours.sum() > 500
    assert (ours & wider(theirs)).sum() > 0.93 * ours.sum()
    assert (theirs & wider(ours)).sum() > 0.93 * theirs.sum()


def found_slider(page):
    """Number of the input field that belongs to the first slider of an action."""
    values = page.locator("input").evaluate_all("all => all.map(one => [one.type, one.value, one.inputMode])")
    texts = [number for number, (_, value, mode) in enumerate(values) if value in ("0", "0.00") and mode == "decimal"]
    return texts[-1] if texts else len(values) - 1


def is_robot(picture):
    """Pixels that are coloured, as soft bodies and cables are, or dark, as what is held fixed."""
    picture = picture.astype(int)
    return (np.ptp(picture, axis=-1) > 30) | (picture.max(axis=-1) < 90)


def wider(mask):
    """A mask grown by a pixel."""
    grown = mask.copy()
    for axis in (0, 1):
        grown |= np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
    return grown
