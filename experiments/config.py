"""Settings of all verbs, composed by Hydra from ``hydra_configs/``.

Fields and defaults live in dataclasses beside the code they configure; this file alone registers them as schemas, so
that a misspelt key or a wrong type fails while the settings are composed. Messages name the nearest valid names.
"""

import dataclasses
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from softwarp import checks
from softwarp.advice import close_to, did_you_mean, nearest
from softwarp.envs import registry
from softwarp.planning import options as planners
from softwarp.policies.options import NetworkConfig
from softwarp.ranges import Seed
from softwarp.training import options as algorithms
from softwarp.training.logs import LoggerConfig
from softwarp.training.options import CloningConfig, DistributedConfig, RunConfig

from .catalogue import CONFIG_DIR, config_folders, group_options


class ConfigError(ValueError):
    """Settings that cannot be composed."""


@dataclass
class TrainConfig(RunConfig):
    """Everything of a training run; RunConfig holds its budget and intervals."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    algo: Any = MISSING  # group algo: the settings of one of the algorithms
    network: NetworkConfig = field(default_factory=NetworkConfig)
    warm_start: str | None = None  # run folder or checkpoint of a trained policy, from whose networks this run starts
    cloning: CloningConfig = field(default_factory=CloningConfig)  # demonstrations to learn from first
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    distributed: DistributedConfig = field(default_factory=DistributedConfig)  # several processes that train together
    num_worlds: int = 64  # that step together, in every rank
    device: str = "cpu"  # or "cuda"; several ranks of a machine take a GPU each
    seed: Seed = 0  # of everything that is drawn
    out: str | None = None  # run folder; None: a new one below runs/

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        for name in ("out", "warm_start"):
            if getattr(self, name) is not None:
                checks.path(getattr(self, name), name)


def env_schema(name: str) -> type:
    """Dataclass of an environment's options as OmegaConf takes them: its name added, tuples declared as lists."""
    return _schema(name, registry.spec(name).config_class())


@cache
def _schema(name: str, config_class: type) -> type:
    hints = typing.get_type_hints(config_class)
    defaults = config_class()
    fields: list[Any] = [("name", str, field(default=name))]
    for item in dataclasses.fields(config_class):
        default = _plain(getattr(defaults, item.name))
        if isinstance(default, list):
            made: Any = field(default_factory=default.copy)
        else:
            made = field(default=default)
        fields.append((item.name, _plain_type(hints[item.name]), made))
    return dataclasses.make_dataclass(f"{config_class.__name__}Schema", fields)


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def _plain_type(hint: Any) -> Any:
    """A type without tuples."""
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        return list[_plain_type(arguments[0])]  # type: ignore[misc]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return _plain_type(next(kind for kind in arguments if kind is not type(None))) | None
    return hint


def register(primary: dict[str, type], envs: Sequence[str] = ()) -> None:
    """Make all schemas known to Hydra; ``primary`` maps a verb to its dataclass, ``envs`` are those needed if known."""
    for verb, schema in primary.items():
        _store(f"{verb}_schema", schema)
    for name in registry.names():
        if not envs or registry.spec(name).file_name in envs:
            _store(registry.spec(name).file_name, env_schema(name), "env")  # needs no file
    for name, schema in algorithms.CONFIGS.items():
        _store(f"{name}_schema", schema, "algo")
    for name, planner_schema in planners.CONFIGS.items():
        _store(f"{name}_schema", planner_schema, "planner")
    _store("mlp_schema", NetworkConfig, "network")
    _store("logger_schema", LoggerConfig, "logger")


def _store(name: str, schema: type, group: str | None = None) -> None:
    """Make a schema known to Hydra, which takes a while, unless it is the one that Hydra holds under that name."""
    store = ConfigStore.instance()
    held = store.repo.get(group, {}) if group else store.repo
    told = held.get(f"{name}.yaml")
    if told is None or OmegaConf.get_type(told.node) is not schema:
        store.store(name, schema, group)


def compose(verb: str, schema: type, overrides: list[str]) -> Any:
    """Settings of a verb as an instance of ``schema``.

    Args:
        verb: Name of the primary file in ``hydra_configs/``.
        schema: Its dataclass.
        overrides: Hydra overrides such as ``env=trunk`` or ``algo.learning_rate=1e-3``.

    Raises:
        ConfigError: If an override names nothing, or its value has the wrong type or range.
    """
    parsed = parse(overrides)
    _refuse_hydras_own(parsed)
    overrides = [*with_own_environments(overrides), *search_path()]
    _choices(verb, parsed)  # before the settings of all that there is are looked up
    register({verb: schema}, [override.value() for override in parsed if override.key_or_group == "env"])
    with hydra.initialize_config_dir(str(CONFIG_DIR), version_base="1.3"):
        try:
            composed = hydra.compose(verb, overrides)
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise ConfigError(_explain(verb, parsed, error)) from error
    return to_object(composed)


def _refuse_hydras_own(parsed: list[Override]) -> None:
    """Raise ConfigError for settings of Hydra itself, which only its sweeps read; a search path is read here too."""
    for override in parsed:
        key = override.key_or_group
        if key.startswith(("hydra.", "hydra/")) and key != "hydra.searchpath":
            raise ConfigError(
                f"setting {override.input_line!r}: Hydra's own settings have an effect on its sweeps alone, "
                "softwarp train -m ...; the folder of a run is out=FOLDER"
            )


def search_path() -> list[str]:
    """The override that lets Hydra find settings of working folder and packages beside softwarp's own."""
    folders = [f"'file://{folder}'" for folder in config_folders(own_packages()) if folder != CONFIG_DIR.resolve()]
    return [f"hydra.searchpath=[{','.join(folders)}]"] if folders else []


OWN: dict[str, str] = {}  # ``module:class`` of an environment that was asked for -> its name in Hydra's group


def own_packages() -> list[str]:
    """Packages of these, which may bring settings too."""
    return [place.partition(":")[0].partition(".")[0] for place in OWN if ".py:" not in place]


def with_own_environments(overrides: list[str]) -> list[str]:
    """Overrides in which ``env=module:class`` is a choice that Hydra knows; also several of them, in sweeps."""

    def known(choice: str) -> str:
        place = choice.strip().strip("'\"")
        if ":" not in place:
            return choice
        if place not in OWN:
            registry.spec(place).env_class()  # after this its package is found, with its settings
            OWN[place] = f"own_{len(OWN)}_{registry.spec(place).file_name}"
        _store(OWN[place], env_schema(place), "env")
        return OWN[place]

    def replaced(text: str) -> str:
        key, _, value = text.partition("=")
        return f"env={','.join(map(known, value.split(',')))}" if key == "env" else text

    return [replaced(text) for text in overrides]


def parse(overrides: list[str]) -> list[Override]:
    """Read overrides.

    Raises:
        ConfigError: If one is not of the form ``key=value``.
    """
    for text in overrides:
        try:
            OverridesParser.create().parse_override(text)
        except HydraException as error:
            raise ConfigError(f"setting {text!r}: write it as key=value ({str(error).splitlines()[0]})") from error
        override = OverridesParser.create().parse_override(text)
        if (override.is_add() or override.is_delete()) and not override.key_or_group.startswith("hydra"):
            raise ConfigError(f"setting {text!r}: settings can be changed, not added or taken away; write key=value")
    parsed: list[Override] = OverridesParser.create().parse_overrides(overrides)
    return parsed


def to_object(config: DictConfig) -> Any:
    """Dataclasses from composed settings, their own checks included; ``env`` becomes a plain dictionary."""
    result = OmegaConf.to_object(config)
    if "env" in config:
        result.env = OmegaConf.to_container(config.env, resolve=True)
        make_env_config(result.env)
    return result


def make_env_config(env: dict[str, Any]) -> tuple[str, Any]:
    """Name and checked options of an environment.

    Raises:
        ConfigError: If a list has the wrong length.
        ValueError: If the environment refuses its options.
    """
    options = {key: value for key, value in env.items() if key != "name"}
    for key, hint in typing.get_type_hints(registry.spec(env["name"]).config_class()).items():
        kinds = [hint, *typing.get_args(hint)]
        wanted = next((typing.get_args(kind) for kind in kinds if typing.get_origin(kind) is tuple), (Ellipsis,))
        value = options.get(key)
        if value is not None and Ellipsis not in wanted and len(value) != len(wanted):
            raise ConfigError(f"env.{key}: needs {len(wanted)} values, got {value}")
    return env["name"], registry.make_config(env["name"], None, options)


def restore(saved: dict[str, Any], overrides: list[str]) -> TrainConfig:
    """Settings of an earlier run with some of its values changed.

    Args:
        saved: What the run's checkpoint holds.
        overrides: ``key=value`` for single values; groups cannot be exchanged any more.

    Raises:
        ConfigError: If an override names nothing or has the wrong type.
    """
    config = OmegaConf.structured(TrainConfig)
    config.env = OmegaConf.structured(env_schema(saved["env"]["name"]))
    config.algo = OmegaConf.structured(algorithms.config_class(saved["algo"].get("name", "ppo")))
    for override in parse(overrides):
        if not isinstance(OmegaConf.select(OmegaConf.create(saved), override.key_or_group), DictConfig):
            continue
        key = override.key_or_group
        raise ConfigError(f"setting {override.input_line!r}: a saved run keeps its {key}; change single values")
    try:
        config = OmegaConf.merge(config, saved)
        for override in parse(overrides):
            OmegaConf.update(config, override.key_or_group, override.value(), force_add=False)
        return typing.cast(TrainConfig, to_object(typing.cast(DictConfig, config)))
    except OmegaConfBaseException as error:
        raise ConfigError(_explain_keys(parse(overrides), _keys(config), error)) from error


def to_plain(config: TrainConfig) -> dict[str, Any]:
    """Settings as plain values, for a file."""
    return dataclasses.asdict(config)


def _choices(verb: str, overrides: list[Override]) -> tuple[dict[str, list[str]], list[str]]:
    """All groups of a verb with what there is to choose from, and the choices made.

    Raises:
        ConfigError: If one of these is none.
    """
    groups = (
        group_options(own_packages())
        if verb in ("train", "record", "reduce", "view", "plan", "eval_policy", "render_policy", "export_policy")
        else {}
    )
    chosen = []
    for override in overrides:
        key, value = override.key_or_group, str(override.value())
        if key in groups and value not in OWN:
            if value not in groups[key]:
                raise ConfigError(f"{key}: there is no {value!r}; {nearest(value, groups[key])}")
        if key in groups:
            chosen.append(f"{key}={OWN.get(value, value)}")
    return groups, chosen


def _explain(verb: str, overrides: list[Override], error: Exception) -> str:
    """Which override is wrong, and what may have been meant."""
    groups, chosen = _choices(verb, overrides)
    try:
        with_choices = hydra.compose(verb, [*chosen, *search_path()])
    except (HydraException, OmegaConfBaseException) as clash:
        lines = _root_lines(clash)
        reason = next((line for line in lines if not line.startswith("In '")), lines[0])  # in which file: chosen tells
        return f"{' '.join(chosen)}: these do not go together ({reason}); leave one of them out"
    return _explain_keys([entry for entry in overrides if entry.key_or_group not in groups], _keys(with_choices), error)


def _explain_keys(overrides: list[Override], keys: list[str], error: Exception) -> str:
    for override in overrides:
        key = override.key_or_group
        if key not in keys and key.split(".")[0] != "hydra":
            return f"setting {override.input_line!r}: there is no {key!r}; {_nearest_key(key, keys)}"
    lines = _root_lines(error)
    key = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("full_key:")), "")
    return f"setting {key}: {lines[0]}" if key else lines[0]


def _root_lines(error: BaseException) -> list[str]:
    """What the first cause of an error says, line by line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return [line.strip() for line in str(error).splitlines() if line.strip()]


SYNONYMS = {  # names of other libraries, and what one would call a thing -> ours
    "lr": "learning_rate",
    "discount": "gamma",
    "n_envs": "num_worlds",
    "num_envs": "num_worlds",
    "worlds": "num_worlds",
    "timesteps": "total_steps",
    "total_timesteps": "total_steps",
    "steps": "total_steps",
    "n_steps": "horizon",
    "rollout_length": "horizon",
    "n_epochs": "epochs",
    "num_minibatches": "minibatches",
    "batch_size": "batch",
    "clip_range": "clip",
    "clip_coef": "clip",
    "ent_coef": "entropy",
    "vf_coef": "value",
    "buffer_size": "capacity",
    "replay_size": "capacity",
    "learning_starts": "warmup_steps",
    "net_arch": "hidden",
    "hidden_sizes": "hidden",
    "layers": "hidden",
    "lstm": "recurrent",
    "environment": "env",
    "enviroment": "env",
    "env_name": "env",
    "env_id": "env",
    "task": "env",
    "algorithm": "algo",
    "agent": "algo",
    "preset": "experiment",
    "config": "experiment",
    "random_seed": "seed",
    "gpu": "device",
    "cuda": "device",
    "output": "out",
    "output_dir": "out",
    "folder": "out",
    "log_dir": "out",
    "minutes": "time_limit",
    "seconds": "time_limit",
    "n_eval_episodes": "evaluation_episodes",
    "substeps": "action_repeat",
    "frame_skip": "action_repeat",
    "episode_length": "max_episode_steps",
    "horizon_length": "max_episode_steps",
    "young": "youngs",
    "young_modulus": "youngs",
    "poisson": "nu",
}


def _nearest_key(key: str, keys: list[str]) -> str:
    """Valid names near a wrong one; a right name in the wrong group, or of another library, is found too."""
    *group, last = key.split(".")
    meant = SYNONYMS.get(last.lower())
    near = [valid for valid in keys if meant is not None and valid.split(".")[-1] == meant]
    if near:
        return did_you_mean([valid for valid in near if valid.split(".")[:-1] == group] or near)
    near = [valid for valid in keys if valid.split(".")[-1] == key.split(".")[-1]]
    near = near or close_to(key, keys, cutoff=0.8)
    return did_you_mean(near) if near else nearest(key, keys)


def _keys(config: Any, prefix: str = "") -> list[str]:
    """Dotted names of all values and groups."""
    names = []
    for key in config:
        names.append(f"{prefix}{key}")
        if not OmegaConf.is_missing(config, key) and OmegaConf.is_dict(config[key]):
            names += _keys(config[key], f"{prefix}{key}.")
    return names
