"""Settings: every file composes, and what is misspelt, of the wrong type or out of range is refused with advice."""

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from experiments import config
from experiments.catalogue import CONFIG_DIR, group_options
from experiments.config import ConfigError, TrainConfig, compose
from experiments.verbs import PlanConfig
from softwarp.envs import registry
from softwarp.planning.search import PlannerConfig
from softwarp.training.options import SHACConfig
from softwarp.training.ppo import PPOConfig
from softwarp.training.sac import SACConfig

ROOT = Path(__file__).parents[2]
PRIMARY = (
    "train",
    "record",
    "reduce",
    "view",
    "plan",
    "eval_policy",
    "render_policy",
    "export_policy",
)  # and those of runs
OPTIONS = group_options()
ALONE = [(group, option) for group in ("experiment", "planner", "preset") for option in OPTIONS[group]]
TOGETHER = {group: OPTIONS[group] for group in ("algo", "logger", "network")}  # no choice of one hides one of another


def train(*overrides):
    return compose("train", TrainConfig, list(overrides))


def environment_of(experiment):
    """The environment that a preset chooses, by its file: given by name, it is the only one that is looked up."""
    defaults = OmegaConf.load(CONFIG_DIR / "experiment" / f"{experiment}.yaml").get("defaults", [])
    return next((entry["override /env"] for entry in defaults if "override /env" in entry), "trunk")


@pytest.mark.parametrize(("group", "option"), ALONE)
def test_every_choice_composes(group, option):
    """Each file of these groups, with its environment's own checks."""
    if group == "planner":
        assert isinstance(compose("plan", PlanConfig, [f"planner={option}", "env=trunk"]).planner, PlannerConfig)
    elif group == "preset":
        planned = compose("plan", PlanConfig, [f"preset={option}"])
        assert option in ("none", f"{registry.spec(planned.env['name']).file_name}_{planned.planner.name}")
    else:
        chosen = environment_of(option)
        composed = train(f"experiment={option}", f"env={chosen}")
        assert isinstance(composed, TrainConfig) and registry.spec(composed.env["name"]).file_name == chosen


@pytest.mark.parametrize("place", range(max(map(len, TOGETHER.values()))))
def test_every_choice_composes_with_others(place):
    """Each file of the other groups, several in one composition."""
    chosen = {group: options[place % len(options)] for group, options in TOGETHER.items()}
    composed = train("env=trunk", *(f"{group}={option}" for group, option in chosen.items()))
    assert isinstance(composed, TrainConfig) and composed.env["name"] == "Trunk"
    assert chosen["algo"].startswith(composed.algo.name)


def test_no_choice_is_left_out():
    """An environment needs no file, only its name: each is composed with one of the experiments, and all groups are."""
    assert {environment_of(option) for option in OPTIONS["experiment"]} == set(OPTIONS["env"])
    assert set(OPTIONS) == {"env", *TOGETHER, *(group for group, _ in ALONE)}


def test_every_primary_file_has_a_schema():
    """train, record, plan, eval, render and export compose to their dataclass, with the defaults of that dataclass."""
    from experiments.verbs import (
        EvalConfig,
        ExportConfig,
        PolicyEvalConfig,
        RecordConfig,
        ReduceConfig,
        RenderConfig,
        TransferConfig,
        ViewConfig,
    )

    assert compose("record", RecordConfig, ["episodes=5"]).episodes == 5
    assert compose("reduce", ReduceConfig, ["modes=5"]).modes == 5
    assert compose("view", ViewConfig, ["worlds=5"]).worlds == 5
    assert compose("plan", PlanConfig, ["replan=3"]).replan == 3
    assert compose("eval_policy", PolicyEvalConfig, ["env=trunk"]).env["name"] == "Trunk"
    assert compose("transfer", TransferConfig, ["seed=5"]).seed == 5
    schemas = {"eval": EvalConfig, "export": ExportConfig, "render": RenderConfig}
    for verb, schema in schemas.items():
        assert compose(verb, schema, []) == schema()
        assert compose(verb, schema, ["seed=5"]).seed == 5
    assert {path.stem for path in CONFIG_DIR.glob("*.yaml")} == {*PRIMARY, *schemas, "transfer"}


def test_defaults_are_the_dataclasses_own():
    """YAML files hold overrides only: without any, each part equals its dataclass."""
    composed = train()
    assert composed.algo == PPOConfig()
    assert train("algo=sac").algo == SACConfig()
    assert train("algo=shac").algo == SHACConfig()
    assert train("algo=ppo_avec").algo == PPOConfig(critic_bias=0.0)
    assert train("algo=sac_avec").algo == SACConfig(critic_bias=0.0)
    assert composed.network == config.NetworkConfig()
    assert composed.logger == config.LoggerConfig()
    assert {f.name: getattr(composed, f.name) for f in dataclasses.fields(config.RunConfig)} == vars(config.RunConfig())
    _, env_config = config.make_env_config(composed.env)
    assert env_config == registry.spec("Trunk").config_class()()


def test_a_file_may_add_a_variant_of_an_environment(tmp_path, monkeypatch):
    """A file in ``env/`` that builds on an environment holds changed values only, and is an option like the others."""
    from experiments import catalogue

    folder = tmp_path / "hydra_configs"
    shutil.copytree(CONFIG_DIR, folder)
    (folder / "env").mkdir(exist_ok=True)
    (folder / "env" / "soft_trunk.yaml").write_text("defaults:\n  - trunk\n  - _self_\nyoungs: 1.0e5\n")
    monkeypatch.setattr(config, "CONFIG_DIR", folder)
    monkeypatch.setattr(catalogue, "CONFIG_DIR", folder)
    assert train("env=soft_trunk").env == train("env=trunk", "env.youngs=1e5").env
    assert {"soft_trunk", "trunk"} <= set(catalogue.group_options()["env"])
    with pytest.raises(ConfigError, match="did you mean 'soft_trunk'"):
        train("env=soft_trnk")


def test_overrides_reach_their_place():
    """Values, lists and presets; what is given by hand wins over a preset."""
    composed = train("experiment=trunk_paper", "env.goals=workspace", "env.youngs_range=[1e5,2e5]", "seed=3")
    assert composed.env["action_kind"] == "discrete"
    assert composed.env["goals"] == "workspace"
    assert composed.env["youngs_range"] == [1e5, 2e5]
    assert composed.network.hidden == [512, 512, 512]
    assert composed.seed == 3


def test_paper_preset_is_the_environment_s_own():
    """experiment=trunk_paper sets what TrunkConfig.paper sets."""
    from softwarp.envs.tasks.trunk import TrunkConfig

    assert config.make_env_config(train("experiment=trunk_paper").env)[1] == TrunkConfig.paper()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("env=trnk", "env: there is no 'trnk'; did you mean 'trunk'"),
        ("algo=pppo", "algo: there is no 'pppo'; did you mean 'ppo' or 'ppo_avec'?"),
        ("env=null", "env: there is no 'None'"),
        ("algo.learnin_rate=1", "there is no 'algo.learnin_rate'; did you mean 'algo.learning_rate'?"),
        ("learning_rate=1", "there is no 'learning_rate'; did you mean 'algo.learning_rate' or"),
        ("env.gols=list", "there is no 'env.gols'; did you mean 'env.goals'?"),
        ("num_world=4", "there is no 'num_world'; did you mean 'num_worlds'?"),
        ("+algo.extra=1", "settings can be changed, not added"),
        ("~algo", "settings can be changed, not added or taken away"),
        ("foo", "setting 'foo': write it as key=value"),
        ("hydra.run.dir=runs/x", "sweeps alone.*out=FOLDER"),
        ("algo.learning_rate=abc", "algo.learning_rate: Value 'abc' of type 'str' could not be converted to Float"),
        ("num_worlds=2.5", "num_worlds: Value '2.5' of type 'float' could not be converted to Integer"),
        ("env.mesh=[1]", "env.mesh"),
        ("env.youngs_range=[1,2,3]", r"env.youngs_range: needs 2 values, got \[1.0, 2.0, 3.0\]"),
        ("algo.clip=-1", "algo.clip: must be positive, got -1"),
        ("algo.name=sac", "algo.name: must stay 'ppo'; choose another algorithm with algo=sac, got sac"),
        ("cloning.held_out=2", "cloning.held_out: must lie in"),
        ("env.goals=nowhere", "unknown goals 'nowhere'"),
        ("total_steps=0", "total_steps: must be at least 1, got 0"),
        ("network.activation=swish", "network.activation: 'swish' is unknown"),
    ],
)
def test_bad_settings_are_refused(override, message):
    """The message names the setting and the nearest valid names or the requirement."""
    others = [] if override.startswith("env=") else ["env=trunk"]  # one environment is looked up sooner than all
    with pytest.raises(ValueError, match=message.replace("?", r"\?").replace("+", r"\+")):
        train(override, *others)


def test_saved_settings_come_back():
    """What a checkpoint holds restores the same settings; single values can be changed, choices cannot."""
    saved = config.to_plain(train("env.mesh=coarse", "algo.horizon=7"))
    assert config.restore(saved, []) == train("env.mesh=coarse", "algo.horizon=7")
    assert config.restore(saved, ["total_steps=5", "env.youngs=1e5"]).env["youngs"] == 1e5
    with pytest.raises(ConfigError, match="a saved run keeps its algo"):
        config.restore(saved, ["algo=ppo"])
    with pytest.raises(ConfigError, match="did you mean 'total_steps'"):
        config.restore(saved, ["total_step=5"])
    with pytest.raises(ConfigError, match=r"could not be converted to Float"):
        config.restore(saved, ["algo.clip=high"])


def test_every_yaml_holds_overrides_only():
    """No file repeats a default of the dataclass it overrides: each value differs from the default it replaces."""
    for group in ("network", "logger"):
        default = OmegaConf.structured({"network": config.NetworkConfig, "logger": config.LoggerConfig}[group]())
        for path in (CONFIG_DIR / group).glob("*.yaml"):
            for key, value in OmegaConf.load(path).items():
                assert key == "defaults" or default[key] != value, f"{path}: {key} repeats the default"


def test_settings_are_found_where_installed(tmp_path):
    """The wheel's layout: experiments/ and hydra_configs/ inside the package, no checkout around."""
    package = tmp_path / "softwarp"
    shutil.copytree(ROOT / "softwarp", package, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("experiments", "hydra_configs"):
        shutil.copytree(ROOT / folder, package / folder, ignore=shutil.ignore_patterns("__pycache__"))
    code = (
        "import softwarp, softwarp.cli as cli; config = cli.experiment('config');"
        "print(softwarp.__file__); print(cli.experiment('catalogue').CONFIG_DIR);"
        "print(config.compose('train', config.TrainConfig, []).env['name'])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [str(package / "__init__.py"), str(package / "hydra_configs"), "Trunk"]


def test_a_schema_that_changes_is_told_anew():
    """Hydra keeps those that it has been told, but not where another one takes the name, whoever told of that one."""
    made = [dataclasses.make_dataclass("Probe", [("probed", int, number)]) for number in (1, 2)]
    for number, schema in enumerate(made, start=1):
        config.register({"probe": schema})
        assert ConfigStore.instance().load("probe_schema.yaml").node.probed == number
    ConfigStore.instance().store("probe_schema", made[0])  # as a second copy of this module does
    config.register({"probe": made[1]})
    assert ConfigStore.instance().load("probe_schema.yaml").node.probed == 2
