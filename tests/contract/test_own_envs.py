"""Environments of one's own: registered, of installed packages, by module or file, and what ``softwarp new`` writes."""

import re
import subprocess
import sys
import warnings

import gymnasium
import pytest
import yaml

import softwarp as sw
from experiments import baselines, catalogue, config, new
from experiments.config import ConfigError, TrainConfig, compose
from softwarp import cli
from softwarp.envs import registry
from softwarp.planning import plans
from tests.unit.envs.fake import PointEnv

OWN = '''
from dataclasses import dataclass
from softwarp.envs.scenes.cart_pole import CartPoleScene
from softwarp.envs.tasks.cart_pole import CartPole, CartPoleConfig

@dataclass(kw_only=True)
class HeavyConfig(CartPoleConfig):
    """Options."""
    cart_mass: float = 3.0  # kg, a heavy cart

class Heavy(CartPole):
    config: HeavyConfig
    later: "NotDefinedHere"

class Light(CartPole):
    pass
'''


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """A working folder with a module ``own_carts`` in it; whatever is registered or imported there is forgotten."""
    (tmp_path / "own_carts.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    monkeypatch.setattr(registry, "_registered", {})
    monkeypatch.setattr(config, "OWN", {})
    registry._installed.cache_clear()
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]
    for name in [key for key in gymnasium.registry if "Heavy" in key or "Barrow" in key]:
        del gymnasium.registry[name]
    registry._installed.cache_clear()


def test_registered_names_are_known_everywhere(own_folder):
    entry = sw.register("Heavy", "own_carts:Heavy", summary="a heavy cart", max_episode_steps=7)
    assert (entry.gym_id, entry.file_name) == ("softwarp/Heavy-v0", "heavy")
    assert "own_carts" not in sys.modules, "imported before it is used"
    assert sw.make("Heavy", num_worlds=2, seed=0).config.cart_mass == 3.0
    assert gymnasium.spec("softwarp/Heavy-v0").max_episode_steps == 7
    assert gymnasium.make("softwarp/Heavy-v0", cart_mass=2.0).unwrapped.env.config.cart_mass == 2.0
    assert compose("train", TrainConfig, ["env=heavy", "env.cart_mass=4"]).env["cart_mass"] == 4.0
    assert "heavy" in catalogue.group_options()["env"]
    assert registry.name_of(entry.env_class()) == "Heavy"
    assert sw.register("Heavy", entry.env_class()) == registry.spec("Heavy"), "the same again"
    for arguments, message in (
        (("Heavy", "own_carts:Light"), "'Heavy' is taken by own_carts:Heavy"),
        (("Trunk", "own_carts:Heavy"), "'Trunk' is taken by softwarp.envs.tasks.trunk:Trunk"),
        (("two words", "own_carts:Heavy"), "must be a Python identifier"),
        (("Cart", "own_carts"), "be a class or 'module:class'"),
        (("Cart", 3), "be a class or 'module:class'"),
    ):
        with pytest.raises(ValueError, match=message):
            sw.register(*arguments)


def test_module_and_file_name_an_environment_without_registration(own_folder):
    for name in ("own_carts:Heavy", "own_carts.py:Heavy", f"{own_folder}/own_carts.py:Heavy"):
        composed = compose("train", TrainConfig, [f"env={name}", "env.cart_mass=4"])
        assert (composed.env["name"], composed.env["cart_mass"]) == (name, 4.0)
        made, options = config.make_env_config(config.restore(config.to_plain(composed), ["env.cart_mass=5"]).env)
        assert (made, type(options).__name__, options.cart_mass) == (name, "HeavyConfig", 5.0)
    for setting in ("small", "fast", "paper"):
        cell = baselines.Cell(own_folder, "own_carts:Heavy", "ppo_avec", 10)
        told = compose("train", TrainConfig, cell.overrides(setting))
        assert (told.env["name"], told.algo.critic_bias, told.out) == (cell.task, 0.0, str(cell.folder))
        assert cell.folder == own_folder / "heavy" / "ppo_avec" / "seed_10"
    env = sw.make("own_carts:Light", num_worlds=1, seed=0)
    assert type(env.config).__name__ == "CartPoleConfig", "what its base declares"
    settings = {"name": registry.name_of(type(env))}
    assert settings == {"name": "own_carts:Light"}
    assert type(plans.make_env(settings)) is type(env)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("own_cart:Heavy", "there is no module 'own_cart', neither installed nor in .*; did you mean 'own_carts'?"),
        ("own_carts:Heavi", "own_carts has no 'Heavi'; did you mean 'Heavy' or 'HeavyConfig'?"),
        ("own_cart.py:Heavy", "there is no file .*own_cart.py; did you mean 'own_carts.py'?"),
        ("own_carts:HeavyConfig", "own_carts:HeavyConfig is no class derived from softwarp.envs.SoftEnv"),
        ("os:path", "os:path is no class derived from"),
        ("trnk", "env: there is no 'trnk'; did you mean 'trunk'"),
        ("own_carts:Heavy env.cart_mas=3", "there is no 'env.cart_mas'; did you mean 'env.cart_mass'"),
    ],
)
def test_mistakes_are_told(own_folder, name, message):
    with pytest.raises(ValueError, match=re.escape(message).replace(r"\.\*", ".*")):
        compose("train", TrainConfig, f"env={name}".split())


def test_installed_packages_bring_environments_and_settings(own_folder, monkeypatch):
    package = own_folder / "site" / "barrows"
    (package / "hydra_configs" / "experiment").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    (package / "task.py").write_text(OWN.replace("Heavy", "Barrow"))
    preset = {"defaults": [{"override /env": "barrow"}], "total_steps": 123}
    (package / "hydra_configs" / "experiment" / "slow.yaml").write_text("# @package _global_\n" + yaml.dump(preset))
    info = own_folder / "site" / "barrows-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: barrows\nVersion: 1.0\n")
    points = "Barrow = barrows.task:Barrow\nTrunk = barrows.task:Trunk\n"
    (info / "entry_points.txt").write_text(f"[softwarp.envs]\n{points}")
    monkeypatch.syspath_prepend(own_folder / "site")
    registry._installed.cache_clear()
    with pytest.warns(
        UserWarning, match=r"'Trunk' is softwarp.envs.tasks.trunk:Trunk; barrows.task:Trunk has the same"
    ):
        assert registry.names()[-1] == "Barrow", "known without being imported"
    assert registry.spec("Trunk").env == "softwarp.envs.tasks.trunk:Trunk"
    (package / "__init__.py").write_text("")
    composed = compose("train", TrainConfig, ["experiment=slow"])
    assert (composed.env["name"], composed.env["cart_mass"], composed.total_steps) == ("Barrow", 3.0, 123)


@pytest.mark.slow
def test_new_package_runs_as_it_is(own_folder, capsys):
    """Written, looked at, trained, tested and exported without being installed; its own tests pass."""
    assert cli.main(["new", "SlowBarrow"]) == 0
    assert "softwarp train env=slow_barrow:SlowBarrow experiment=slow_barrow" in capsys.readouterr().out
    folder = own_folder / "slow_barrow"
    text = "".join(path.read_text() for path in folder.rglob("*") if path.is_file())
    assert not re.search("my_robot|MyRobot|My robot", text)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    sys.path.append(str(folder))  # as working in it
    small = [
        "total_steps=64",
        "num_worlds=4",
        "algo.horizon=8",
        "evaluations=1",
        "evaluation_episodes=2",
        "logger=quiet",
    ]
    own = "env=slow_barrow:SlowBarrow"
    for words in (
        ["train", own, "experiment=slow_barrow", *small, "out=run"],
        ["eval", "run", "episodes=2", "--baselines"],
        ["render", own, "policy=scripted", "rule.png", "width=64", "height=48", "frames=2"],
        ["export", "run", "motion.usda"],
        ["record", "shown.npz", own, "policy=scripted", "episodes=2"],
        ["bench", "--quick", "--env", "slow_barrow:SlowBarrow", "--worlds", "1"],
    ):
        with warnings.catch_warnings():
            assert cli.main(words) == 0, capsys.readouterr().err
    assert "scripted" in capsys.readouterr().out, "the policy that the class holds"
    assert all((own_folder / name).stat().st_size > 0 for name in ("rule.png", "motion.usda", "shown.npz"))
    assert cli.main(["new", "slow-barrow"]) == 2
    assert "there is a package slow_barrow already" in capsys.readouterr().err


def test_a_misspelt_setting_beside_an_own_preset_is_the_one_told(own_folder):
    assert cli.main(["new", "soft_finger"]) == 0
    sys.path.insert(0, str(own_folder / "soft_finger"))
    preset = ["env=soft_finger:SoftFinger", "experiment=soft_finger"]
    with pytest.raises(ConfigError, match="did you mean 'time_limit'"):
        compose("train", TrainConfig, [*preset, "time_limt=9"])


def test_errors_name_the_line_of_own_code(own_folder, capsys):
    """Whatever a hook raises; what no own code leads to names none."""
    broken = OWN + "    def setup(self):\n        raise ValueError('a cart too light')\n"
    (own_folder / "own_carts.py").write_text(broken)
    small = ["num_worlds=1", "total_steps=8", "logger=quiet", "out=run"]
    assert cli.main(["train", "env=own_carts:Light", *small]) == 2
    (place,) = re.findall(r"a cart too light \((.*), line (\d+), in setup\)", capsys.readouterr().err)
    assert place == (str(own_folder / "own_carts.py"), str(broken.count("\n")))
    assert cli.main(["train", "env=cart_pole", *small, "env.dt=-1"]) == 2
    assert "line" not in capsys.readouterr().err


@pytest.mark.parametrize("name", ["3d", "class", "a/b", "", "Trunk", "numpy"])
def test_names_that_make_no_package_are_refused(name):
    with pytest.raises(ValueError, match="name"):
        new.names(name)


def test_classes_that_files_cannot_name():
    class Inner(PointEnv):
        pass

    with pytest.raises(ValueError, match="Inner is defined in a function"):
        registry.name_of(Inner)
    Inner.__qualname__, Inner.__module__ = "Inner", "__main__"
    with pytest.raises(ValueError, match="Inner is defined in a program"):
        registry.name_of(Inner)
