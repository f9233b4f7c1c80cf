"""``softwarp view`` and ``Viewer``: what browsers see is the simulation, and what users set reaches it."""

import dataclasses
import json
import sys
import threading
import time

import gymnasium
import numpy as np
import pytest
import torch

import softwarp
from benchmarks import view
from experiments import browser
from experiments.view import drivers
from softwarp import cli
from softwarp.io.trajectory import Recorder
from softwarp.policies.baselines.table import rule
from softwarp.render import Camera, RayCaster
from softwarp.training import demonstrations

viser = pytest.importorskip("viser", reason="the extra 'view' is not installed")

from softwarp.view import HAND, Player, Viewer, write_html  # noqa: E402
from softwarp.view.paint import ContactPressure, surface_strain  # noqa: E402


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


def run_until(viewer, holds, limit=60.0):
    """Run until something holds, however slow the machine is."""
    until = time.monotonic() + limit
    while not holds() and time.monotonic() < until:
        viewer.run(0.1)


def test_meshes_follow_the_nodes(viewer):
    """Every picture holds the surface of every world where the simulation has it; nothing is made anew."""
    server, names = viewer._server, set(viewer.stage.bodies)
    run_until(viewer, lambda: viewer.actions > 2)
    kept = len(server._websock_server._broadcast_buffer.message_from_id)
    run_until(viewer, lambda: viewer.actions > 5 and viewer.pictures > 10)
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


def test_choices_have_names():
    """Discrete actions are chosen from a list of what they do, and those of a policy are shown in it."""
    with Viewer(softwarp.make("CatchTheObject")) as viewer:
        assert [slider.label for slider in viewer.panel._sliders] == ["pressure"]
    with Viewer(softwarp.make("CartPole", action_kind="discrete")) as viewer:
        choice = viewer.panel._choice
        assert choice.options == ("0: push to +x", "1: push to -x")
        viewer.panel.show_action(torch.tensor([1]))
        assert choice.value == "1: push to -x" and viewer.panel.action().tolist() == [1]


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
        sensor = next(iter(viewer.panel._sources))
        viewer.panel._plotted.value = sensor
        plot = viewer.panel._sensor
        run_until(viewer, lambda: plot.visible)
        assert plot.visible and len(plot.data) == len(plot.series) and len(plot.data[0]) > 1
        assert np.isfinite(plot.data[1]).all() and plot.title.startswith(sensor)
        for handle in viewer.stage.bodies.values():
            assert np.isfinite(handle.vertices).all() and np.ptp(handle.vertices, axis=0).max() > 0.0
        for handle, world, chamber in viewer.stage._chambers:
            there = viewer.stage._chamber_points(env.sim.node_x.numpy())
            there = there[world, viewer.stage.parts.cavity_points(chamber)]
            assert handle.visible and np.abs(handle.vertices - there).max() < 1e-2


def test_contact_pressure():
    """All of a force is on the surface that it touches, none on one farther away than an edge; NaN is no contact."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    x = np.concatenate([square, square + (0, 0, 5.0)])
    tri = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    pressure = ContactPressure(tri)(
        x, [[0.1, 0.1, 0.2], [0.9, 0.8, 0], [np.nan] * 3], [[0, 0, 3.0], [0, 4.0, 0], [9, 0, 0]]
    )
    assert pressure[:2].sum() * 0.5 == pytest.approx(7.0) and (pressure[2:] == 0.0).all()


def test_contact_forces():
    """A gripper that holds its cube is coloured where it touches, and an arrow stands for every force."""
    env = softwarp.make("Gripper", num_worlds=1, seed=0)
    with Viewer(env, {"scripted": rule(env, "Gripper")}, port=8235, speed=4.0) as viewer:
        td, policy = env.reset(), rule(env, "Gripper")
        while not bool((env.sim.contact_load.norm(dim=-1) > 1e-3).any()):
            td = env.step(policy(td))["next"]
        viewer.panel._contacts.value, viewer.panel._color.value = True, "contact"
        viewer.draw()
        arrows, forces = viewer.stage._forces.handle, env.sim.contact_load[0]
        along = np.diff(arrows.points, axis=1)[:, 0]
        assert arrows.visible and 0 < len(along) <= int((forces.norm(dim=1) > 0).sum())
        strongest = forces[forces.norm(dim=1).argmax()].numpy()
        longest = along[np.linalg.norm(along, axis=1).argmax()]
        assert longest @ strongest == pytest.approx(np.linalg.norm(longest) * np.linalg.norm(strongest), rel=1e-4)
        assert viewer.stage.limits["contact"] > 1.0


def test_who_can_act():
    """Hand-written rules, inverse control and a planner take turns; one that cannot act leaves it to the user."""
    env = softwarp.make("CartStemContact", num_worlds=1, seed=0)
    found = drivers(env, "CartStemContact", "")
    assert list(found)[:4] == ["scripted", "direct", "inverse", "cem"]
    with Viewer(env, found | {"broken": broken}, port=8240, speed=4.0) as viewer:
        for name in ("direct", "inverse", "cem"):
            viewer.panel._driver.value, taken = name, viewer.actions
            run_until(viewer, lambda taken=taken: viewer.actions > taken)
            assert viewer.actions > taken and viewer.panel.driver == name
        viewer.panel._driver.value = "broken"
        viewer.run(0.2)
        assert viewer.panel.driver == HAND and "no plan" in viewer._trouble


def broken(_):
    raise ValueError("no plan today")


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


def test_pictures_per_second(monkeypatch, capsys, tmp_path):
    """``softwarp bench view`` tells rates and processor time that belong together."""
    monkeypatch.setattr(view, "INTERVAL", 0.4)
    monkeypatch.setattr(view, "WARM_UP", 0.1)
    words = ["--env", "CartPole", "--seconds", "0.8", "--no-browser", "--json", str(tmp_path / "rates.json")]
    assert view.main(words) == 0
    told = json.loads((tmp_path / "rates.json").read_text())["intervals"]
    assert len(told) == 2 and all(0.0 < one["pictures"] < 70.0 and one["frames"] == 0.0 for one in told)
    assert all(0.0 < one["speed"] < 1.6 and one["own"] > 0.0 for one in told)
    assert "2 intervals" in capsys.readouterr().out


@pytest.mark.skipif(browser.path() is None, reason="no Chromium here; apt install chromium")
def test_in_browsers(recording, tmp_path):
    """What users do in a browser without a GPU, in one process of it, whose start costs most.

    A page shows the robot's silhouette; a slider that is moved there and a step that is asked for there move the robot;
    a second page comes, the first one goes, the simulation goes on; the page of a recording, opened as a file, plays
    and asks nobody. No page tells an error.
    """
    pytest.importorskip("playwright.sync_api")
    page_file = write_html(recording, tmp_path / "bubble.html")
    env = softwarp.make("Trunk", num_worlds=1, seed=0)
    viewer = Viewer(env, {}, port=8250)
    viewer.panel._paused.value = True
    for handle in (*viewer.stage._goals, *viewer._handles):
        handle.visible = False
    found = {"errors": [], "start": env.sim.node_x.clone()}

    def browse():
        try:
            with browser.chromium() as program:
                drive(program, viewer, found)
                play(program, page_file, found)
        finally:
            viewer.stop()

    with viewer:
        thread = threading.Thread(target=browse)
        thread.start()
        viewer.run(300.0)
        thread.join(10.0)
    assert not found["errors"] and found["clients"] == (1, 2, 1)
    assert 0.5 in [round(value, 3) for value in found["value"]]
    assert found["actions"] == (1, 2) and found["moved"] > 1e-4
    assert found["drawn"].sum() > 500 and are_alike(found["drawn"], found["picture"])
    assert found["shots"] >= 3  # the recording moves
    assert not [url for url in found["asked"] if url.startswith(("http:", "https:", "ws:", "wss:"))]


def opened(program, url, found):
    """A page that tells its errors; small, as every pixel is drawn by a core."""
    return browser.opened(program, url, 420, 320, found["errors"])


def wait(page, holds, limit=60.0):
    """Until something holds, or the time is over, which later checks notice."""
    until = time.monotonic() + limit
    while not holds() and time.monotonic() < until:
        page.wait_for_timeout(50)


def drive(program, viewer, found):
    """Look, move a slider, ask for a step; then somebody else comes."""
    page = opened(program, viewer.url, found)
    wait(page, lambda: viewer.clients == 1)
    first = viewer.clients
    client = next(iter(viewer._server.get_clients().values()))
    found["drawn"] = found["picture"] = np.zeros((240, 320), bool)

    def ask():  # until the page has told its camera, got all meshes and drawn them
        until = time.monotonic() + 90.0
        while time.monotonic() < until and not (found["drawn"].any() and are_alike(found["drawn"], found["picture"])):
            found["picture"] = is_robot(client.get_render(240, 320))
            seen = client.camera
            places = (tuple(map(float, v)) for v in (seen.position, seen.look_at, seen.up_direction))
            camera = Camera(*places, float(np.degrees(seen.fov)))
            caster = RayCaster.for_model(viewer.env.sim.model, width=320, height=240, camera=camera)
            found["drawn"] = is_robot(caster.draw(viewer.env.sim)[0])

    asked = threading.Thread(target=ask, daemon=True)
    asked.start()
    wait(page, lambda: not asked.is_alive(), 120.0)
    field = page.locator("input").nth(found_slider(page))
    field.fill("0.5")
    field.press("Enter")
    wait(page, lambda: bool((viewer.panel.action() != 0.0).any()))
    found["value"] = viewer.panel.action()[0].tolist()
    page.get_by_text("single step").click()
    wait(page, lambda: viewer.actions == 1)
    one = viewer.actions
    found["moved"] = float((viewer.env.sim.node_x - found["start"]).norm(dim=-1).max())
    other = opened(program, viewer.url, found)
    wait(other, lambda: viewer.clients == 2)
    both = viewer.clients
    page.close()
    wait(other, lambda: viewer.clients == 1)
    found["clients"] = (first, both, viewer.clients)
    viewer.panel._ask_step()
    wait(other, lambda: viewer.actions == 2)
    found["actions"] = (one, viewer.actions)
    other.close()


# What a page has just drawn: read within the frame, as WebGL's picture is gone after it.
DRAWN = """() => new Promise(done => requestAnimationFrame(() => {
    const pictures = [...document.querySelectorAll("canvas")].map(one => one.width ? one.toDataURL() : "");
    done(pictures.sort((a, b) => b.length - a.length)[0]);
}))"""


def play(program, page_file, found):
    """Open the page of a recording as a file, until it has shown three pictures."""
    page, found["asked"] = program.new_page(viewport={"width": 320, "height": 240}), []
    page.on("pageerror", lambda error: found["errors"].append(str(error)))
    page.on("request", lambda request: found["asked"].append(request.url))
    page.goto(page_file.as_uri())
    page.wait_for_selector("canvas", state="attached", timeout=60000)
    shots = set()

    def has_moved():
        shots.add(page.evaluate(DRAWN))
        return len(shots) >= 3

    wait(page, has_moved)
    found["shots"] = len(shots)


def found_slider(page):
    """Number of the input field that belongs to the first slider of an action."""
    values = page.locator("input").evaluate_all("all => all.map(one => [one.type, one.value, one.inputMode])")
    texts = [number for number, (_, value, mode) in enumerate(values) if value in ("0", "0.00") and mode == "decimal"]
    return texts[-1] if texts else len(values) - 1


def is_robot(picture):
    """Pixels that are coloured, as soft bodies and cables are, or dark, as what is held fixed."""
    picture = picture.astype(int)
    return (np.ptp(picture, axis=-1) > 30) | (picture.max(axis=-1) < 90)


def are_alike(ours, theirs):
    """Whether nearly all pixels of either silhouette are those of the other one, or beside them."""
    return all((a & wider(b)).sum() > 0.93 * a.sum() for a, b in ((ours, theirs), (theirs, ours)))


def wider(mask):
    """A mask grown by a pixel."""
    grown = mask.copy()
    for axis in (0, 1):
        grown |= np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
    return grown


@pytest.fixture(scope="module")
def recording():
    """Six frames of two worlds of a robot with chambers and contact."""
    env = softwarp.make("BubbleMotion", num_worlds=2, seed=0)
    td, policy = env.reset(), rule(env, "BubbleMotion")
    recorder = Recorder(env.sim, worlds=[0, 1], contacts=True)
    for _ in range(6):
        recorder.capture(goal=env.goal_points())
        td = env.step(policy(td))["next"]
    return recorder.finish()


def test_strain_of_surfaces():
    """Stretched in one direction, sheared, turned: the largest strain in the plane is known."""
    rest = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]] * 3)
    now = rest.copy()
    now[0, 1] = (1.5, 0, 0)  # E = (1.5^2 - 1) / 2
    now[1, 2] = (0.2, 1, 0)  # simple shear: (F'F - 1) / 2 = [[0, .1], [.1, .02]]
    now[2] = now[2][:, [2, 0, 1]]  # a turn in space
    strain = surface_strain(rest, now)
    np.testing.assert_allclose(strain[:2], [0.625, np.linalg.eigvalsh([[0, 0.1], [0.1, 0.02]])[1]], rtol=1e-12)
    assert abs(strain[2]) < 1e-7
    assert surface_strain(np.zeros((1, 3, 3)), now[:1]) == 0.0  # a triangle without area has none


def test_painted_surfaces(viewer):
    """Colours hold every soft triangle once, in place of the plain body; the strained ones in other colours."""
    viewer.panel._color.value = "strain"
    viewer.run(0.7)
    viewer.draw()
    stage = viewer.stage
    soft = stage._solids.triangles[stage._solids.tri_owner == -1]
    areas = [area(handle) for handle in stage._painted.handles if handle.visible]
    x = stage.bodies["soft"].vertices.reshape(stage.count, -1, 3)[:, soft].reshape(-1, 3, 3)
    whole = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1).sum() / 2
    assert not stage.bodies["soft"].visible and len(areas) > 2
    assert sum(areas) == pytest.approx(whole, rel=1e-4)
    assert stage.limits["strain"] > 0.01
    viewer.panel._color.value = "stress"
    viewer.draw()
    assert stage.limits["stress"] > 1e3
    viewer.panel._color.value = "plain"
    viewer.draw()
    assert stage.bodies["soft"].visible and not any(handle.visible for handle in stage._painted.handles)


def area(handle):
    """Of a mesh whose triangles have corners of their own [m^2]."""
    a, b, c = np.moveaxis(handle.vertices.reshape(-1, 3, 3), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_recordings_are_scrubbed(recording):
    """Every frame shows bodies and goals where they were; the slider leads, and time goes on from there."""
    with Player(recording, port=8270) as player:
        player._plays.value = False
        for frame in (3, 0, 5):
            player.frame.value = frame
            player.run(0.05)
            handle, chosen = player.reel.bodies["soft"]
            x = handle.vertices.reshape(2, -1, 3) - player.reel.offsets[:, None]
            np.testing.assert_allclose(x, recording.vertex_x[frame][:, chosen], atol=1e-6)
            for world, goal in enumerate(player.reel._goals):
                np.testing.assert_allclose(
                    goal.position - player.reel.offsets[world], recording.goal[frame, world], atol=1e-6
                )
        player.frame.value, player._plays.value, player._repeats.value = 1, True, False
        player.run(0.3)
        assert player.frame.value > 1
        player._color.value, player._chambers.value = "stress", True
        player.run(0.1)
        assert not player.reel.bodies["soft"][0].visible and player.reel._chambers[0][0].visible
        assert "Pa" in player._told.content


def test_pages_that_play(recording, tmp_path):
    """A page holds all frames; what a recording cannot be coloured by is refused, and nothing is left behind."""
    page = write_html(recording, tmp_path / "bubble.html", color="stress")
    text = page.read_text()
    assert "__VISER_EMBED_DATA__" in text and len(text) > 500_000
    with pytest.raises(ValueError, match=r"\.html"):
        write_html(recording, tmp_path / "bubble.htm")
    bare = dataclasses.replace(recording, stress=None)
    with pytest.raises(ValueError, match="'stress'; it has plain, strain"):
        write_html(bare, tmp_path / "bare.html", color="stress")
    assert [path.name for path in tmp_path.iterdir()] == ["bubble.html"]


def test_recordings_by_command(recording, tmp_path, capsys, monkeypatch):
    """Recordings are shown, exported and drawn; settings of an environment, missing files and others are refused."""
    monkeypatch.chdir(tmp_path)
    recording.save("bubble.npz")
    assert cli.main(["view", "bubble.npz", "seconds=0.3", "port=8290"]) == 0
    assert "6 frames, at http://localhost:829" in capsys.readouterr().out
    for words, message in (
        (["bubble.npz", "env=trunk"], "has its own environment"),
        (["other.npz"], "no such file"),
        (["nothing"], "no such folder or checkpoint"),
        (["bubble.npz", "other.npz"], "give one recording"),
    ):
        assert cli.main(["view", *words]) == 2
        assert message in capsys.readouterr().err
    for words in (["export", "bubble.npz", "bubble.usda"], ["render", "bubble.npz", "a.png", "width=64", "height=48"]):
        assert cli.main(words) == 0 and (tmp_path / words[2]).stat().st_size > 1000
    np.savez_compressed("demos.npz", format=np.array(demonstrations.FORMAT), observation=np.zeros((9, 3)))
    for words, message in (
        (["export", "bubble.npz", "b.usda", "worlds=2"], "recorded already"),
        (["export", "other.npz", "b.usda"], "no such file"),
        (["export", "demos.npz", "b.usda"], "holds demonstrations, what a policy saw and did, without the motion"),
        (["eval", "demos.npz"], "an .npz file of arrays, as recordings and demonstrations are, no checkpoint"),
    ):
        assert cli.main(words) == 2
        assert message in capsys.readouterr().err
    assert cli.main(["export", "page.html", "env=cart_pole", "policy=scripted", "env.max_episode_steps=3"]) == 0
    assert (tmp_path / "page.html").stat().st_size > 500_000
