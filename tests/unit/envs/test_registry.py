"""Names, options and devices: what is wrong is named together with what would be right."""

import subprocess
import sys

import pytest

from softwarp import envs
from softwarp.envs import registry


@pytest.mark.parametrize("name", ["trunk", "Trnk", "TRUNK"])
def test_unknown_environment_lists_the_nearest(name):
    with pytest.raises(ValueError, match=rf"unknown environment '{name}'.*'Trunk'"):
        registry.make(name)


def test_hopeless_name_lists_all():
    with pytest.raises(
        ValueError, match="valid names are " + ", ".join(f"'{name}'" for name in sorted(registry.names()))
    ):
        registry.spec("zzzzzz")


@pytest.mark.parametrize(("name", "file"), [("Trunk", "trunk"), ("CartStemContact", "cart_stem_contact")])
def test_file_names_are_in_snake_case(name, file):
    assert registry.spec(name).file_name == file


def test_unknown_option_lists_the_nearest():
    with pytest.raises(ValueError, match=r"no option 'action_kid'.*did you mean 'action_kind'"):
        registry.make("Trunk", action_kid="discrete")


def test_unknown_value_lists_the_nearest():
    with pytest.raises(ValueError, match=r"unknown observation 'papr'.*'paper'"):
        registry.make("Trunk", observation="papr")


@pytest.mark.parametrize("num_worlds", [0, -3, 1.5, True, "4"])
def test_num_worlds_is_a_positive_integer(num_worlds):
    with pytest.raises(ValueError, match="num_worlds must be an integer of at least 1"):
        registry.make("Trunk", num_worlds=num_worlds)


@pytest.mark.parametrize("device", ["cuda:77", "gpu", "cpu:3"])
def test_missing_device_lists_those_present(device):
    with pytest.raises(ValueError, match=rf"device '{device}' is not available; this machine has cpu"):
        registry.make("Trunk", device=device)


def test_config_of_another_environment_is_refused():
    from softwarp.envs.base import EnvConfig

    with pytest.raises(ValueError, match="config must be a TrunkConfig, got EnvConfig"):
        registry.make("Trunk", config=EnvConfig())


def test_options_override_a_config():
    from softwarp.envs.tasks.trunk import TrunkConfig

    config = registry.make_config("Trunk", TrunkConfig(mesh="coarse"), {"max_episode_steps": 7})
    assert (config.mesh, config.max_episode_steps) == ("coarse", 7)


def test_table_is_light_and_true():
    """Listing environments loads no Torch; what follows from a line agrees with the classes and is offered by name."""
    probe = "import sys; from softwarp.envs import registry; registry.names(); print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True).stdout.strip() == "False"
    for name in registry.names():
        entry = registry.spec(name)
        assert entry.env_class() is getattr(envs, name)
        assert entry.config_class() is getattr(envs, f"{name}Config")
        assert entry.config_class().__name__ == f"{name}Config"
        assert entry.config_class()().max_episode_steps == entry.max_episode_steps
        assert entry.env_class().__module__ == f"softwarp.envs.tasks.{entry.file_name}"
        assert {name, f"{name}Config"} <= set(dir(envs))
