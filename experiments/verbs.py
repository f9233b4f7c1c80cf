"""Settings of the verbs that use policies and environments: eval, render, export, record and plan.

Nothing here loads Torch or Warp, so that whatever is wrong with a command is told before those are waited for; each
function composes the settings of a verb and looks at all in them that can be known without.
"""

import ctypes
import dataclasses
import math
import re
from argparse import ArgumentTypeError
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softwarp.envs.options import Count, Further, NotNegative, Pixels, Positive, Share
from softwarp.io.atomic import prove_writable
from softwarp.planning.options import CONFIGS, ModelConfig
from softwarp.policies.baselines.names import NAMES, UNLEARNED, unknown_rule
from softwarp.ranges import Limit, Seed, check_fields

from .catalogue import group_options
from .config import ConfigError, compose, own_packages, parse, restore

ENDINGS = {  # of what is written
    "render": (".mp4", ".gif", ".png"),
    "export": (".usdc", ".usda", ".usdz", ".npz", ".html"),
    "record": (".npz",),
    "reduce": (".npz",),
    "policy export": (".onnx", ".pt2"),
}
PICTURES = (".png", ".svg", ".pdf")
PLAN = ".json"  # ending of a plan file
RECORDING = ".npz"  # ending of a recorded trajectory
COMMANDS = ".csv"  # ending of a file of commands
INVERSE = "inverse"  # name of inverse control among the policies
MINARI = "minari:"  # begins the name of a data set
_DRIVERS = ("libcuda.so.1", "/usr/lib/wsl/lib/libcuda.so.1")


def folder_name(text: str) -> Path:
    """A folder that a command line names.

    Raises:
        ArgumentTypeError: For a setting in its place, and for nothing.
    """
    if not text.strip() or "=" in text:
        raise ArgumentTypeError(f"{text!r} is no folder; name one that everything goes to first, without '='")
    return Path(text)


@dataclass
class EvalConfig:
    """Settings of ``softwarp eval``."""

    run: str = ""  # run folder or checkpoint
    episodes: Count = 64
    seed: Seed = 2_000_003  # of the goals; differs from the one by which training chose its best policy
    baselines: bool = False
    json: str | None = None  # file to write, "-" for standard output
    device: str = "cpu"
    devices: list[str] = field(default_factory=list)  # that share the worlds, in place of ``device``; empty: that one
    num_worlds: Count = 64  # that step together, on all devices

    def __post_init__(self) -> None:
        """Refuse values of a wrong type."""
        check_fields(self, "eval")


@dataclass
class PolicyEvalConfig:
    """Settings of ``softwarp eval env=... policy=...``: a policy that was not trained."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    policy: str = INVERSE  # "inverse", or the name of a hand-written policy
    episodes: Count = 64
    seed: Seed = 2_000_003  # of the goals
    json: str | None = None  # file to write, "-" for standard output
    device: str = "cpu"
    devices: list[str] = field(default_factory=list)  # that share the worlds, in place of ``device``; empty: that one
    num_worlds: Count = 64  # that step together, on all devices

    def __post_init__(self) -> None:
        """Refuse values of a wrong type."""
        check_fields(self, "eval")


@dataclass(kw_only=True)
class ShownConfig:
    """Settings that render and export have in common."""

    run: str = ""  # run folder, checkpoint or plan file
    out: str = ""  # file to write
    worlds: Count = 1  # side by side, each with a goal of its own; a plan has one
    contacts: bool = False  # contact points and forces
    seed: Seed = 2_000_003  # of the goals
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values of a wrong type."""
        check_fields(self, type(self).__name__.removeprefix("Policy").removesuffix("Config").lower())


@dataclass(kw_only=True)
class RenderConfig(ShownConfig):
    """Settings of ``softwarp render``."""

    width: Pixels = 640  # pixels of one world
    height: Pixels = 480
    frames: Count = 6  # on a .png sheet
    stress: bool = False  # colour soft bodies by von Mises stress
    inversions: bool = True  # mark elements that are inside out


@dataclass(kw_only=True)
class ExportConfig(ShownConfig):
    """Settings of ``softwarp export``."""

    stress: bool = True  # record von Mises stress for the colours


@dataclass(kw_only=True)
class PolicyConfig:
    """Settings in place of a run."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    policy: str = INVERSE  # "inverse", the name of a hand-written policy, a run folder or checkpoint, or a plan file


@dataclass
class ViewConfig:
    """Settings of ``softwarp view``."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    policy: str = ""  # who acts until the user does: hand-written, "inverse", a planner, trained; "": hand-written
    worlds: Count = 1  # side by side, each with a goal of its own
    host: str = "127.0.0.1"  # address to listen at; 0.0.0.0 lets other machines connect
    port: int = 8080  # or the next one that is free
    speed: Positive = 1.0  # simulated time over that of the clock
    fps: Positive = 60.0  # pictures per second, at most
    seconds: Limit = math.inf  # after which to stop
    seed: Seed = 2_000_003  # of the first episode
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "view")
        if not 1 <= self.port <= 65535:
            raise ValueError(f"port: must lie in [1, 65535], got {self.port}")


@dataclass
class ReduceConfig:
    """Settings of ``softwarp reduce``."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    body: str = ""  # name of the soft body; "" for the one with most tets
    out: str = ""  # file to write, .npz; a picture of modes and elements lies beside it
    policy: str = "random"  # who moves the robot: "random", a hand-written policy, "inverse", or a trained one
    num_worlds: Count = 32  # that move side by side
    actions: Count = 40  # of every world
    looks: Count = 3  # states of every action that are kept, at most
    modes: int = 0  # besides rigid ones; 0 for as few as tolerance allows
    tolerance: Positive = 1e-3  # part of the motion that the modes may leave out
    contact_modes: int = 0  # besides, for what contact forces bring about and the others leave out
    frame: str = "fixed"  # or "floating": modes turn with the body, for robots that turn or tumble
    norm: str = "mass"  # lengths that modes are chosen by: of "mass", or what a "step" sees, mass and stiffness
    element_tolerance: NotNegative = 0.03  # error of forces of tets, as displacements; 0 keeps all tets
    membrane_tolerance: NotNegative = 0.03  # likewise of membranes
    states: Count = 96  # that elements are chosen by
    compare: int = 20  # unseen actions that both models carry out; 0 for none
    seed: Seed = 4_000_037
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "reduce")
        if self.norm not in ("step", "mass"):
            raise ValueError(f"norm: must be step or mass, got {self.norm!r}")
        if self.frame not in ("fixed", "floating"):
            raise ValueError(f"frame: must be fixed or floating, got {self.frame!r}")
        for name in ("modes", "contact_modes", "compare"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}: must be at least 0, got {getattr(self, name)}")


@dataclass
class RecordConfig:
    """Settings of ``softwarp record``."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    policy: str = "scripted"  # name of a hand-written policy, "inverse", or a run folder or checkpoint
    out: str = ""  # archive to write, .npz, or minari: and the name of a data set
    episodes: int = 100
    noise: float = 0.1  # part of the steps at which a random action is carried out instead of the policy's
    num_worlds: int = 50  # that step together
    seed: Seed = 3_000_017  # of starts and goals
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "record")
        for name in ("episodes", "num_worlds"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        if not 0.0 <= self.noise < 1.0:
            raise ValueError(f"noise: must lie in [0, 1), got {self.noise:g}")


@dataclass
class PlanConfig:
    """Settings of ``softwarp plan``."""

    env: Any = MISSING  # group env: ``name`` and the options of that environment
    planner: Any = MISSING  # group planner: the settings of one of the planners
    model: ModelConfig = field(default_factory=ModelConfig)  # actions, rewards and memory of the planner's own worlds
    replan: int = 0  # actions of a plan that are carried out before the next one is made; 0: all
    episodes: int = 1  # starts and goals to plan for, one after the other
    out: str | None = None  # file for what the first episode carried out, and its first search, .json
    picture: str | None = None  # of the same, .png, .svg or .pdf
    summary: str | None = None  # file for the outcome of all episodes, .json
    num_worlds: int = 0  # of the planner's pool; 0: as many as a round of the planner steps at once
    seed: Seed = 0  # of starts and goals
    device: str = "cpu"
    devices: list[str] = field(default_factory=list)  # that share the planner's pool; empty: ``device`` alone
    progress: bool = True

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "plan")
        for name, least in (("episodes", 1), ("replan", 0), ("num_worlds", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: must be at least {least}, got {getattr(self, name)}")
        for name, endings in (("out", (PLAN,)), ("summary", (PLAN,)), ("picture", PICTURES)):
            path = getattr(self, name)
            if path is not None and Path(path).suffix not in endings:
                raise ValueError(f"{name}={path}: needs the ending {' or '.join(endings)}")


@dataclass
class TransferConfig:
    """Settings of ``softwarp transfer``."""

    env: Any = MISSING  # group env, given as to=... and to.KEY=...: the robot that is to follow, and its options
    out: str | None = None  # file for its commands, .csv
    summary: str | None = None  # file for what came of them, .json
    picture: str | None = None  # of plan and replay side by side, .png, .svg or .pdf
    period: Positive = 0.05  # s, between two commands
    ramp: NotNegative = 0.2  # s, in which a plate turns to a new direction
    height: Positive | None = None  # m, of a plate; None: that at which it stands
    rest: NotNegative = 1.0  # s, for which the first commands are held, where the height or a world's parameters differ
    replays: Further = 0  # worlds that differ, in which the commands are played again; 0: none
    spread: Share = 0.2  # part by which modulus, friction and mass of the ball differ at most
    offset: NotNegative = 0.02  # rad or m, largest error of an actuator's zero
    delay: NotNegative = 0.04  # s, by which commands come late at most
    closed: list[str] = field(default_factory=list)  # loops: "replan", hand-written policies or runs of Maze
    replan: Positive = 0.5  # s, between two plans of closed=[replan]
    depth: Count = 2  # actions that these look ahead
    seed: Seed = 0
    device: str = "cpu"

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "transfer")
        for name, endings in (("out", (COMMANDS,)), ("summary", (PLAN,)), ("picture", PICTURES)):
            path = getattr(self, name)
            if path is not None and Path(path).suffix not in endings:
                raise ValueError(f"{name}={path}: needs the ending {' or '.join(endings)}")


FILMS: dict[str, type] = {"render": RenderConfig, "export": ExportConfig}


def without_run(schema: type) -> type:
    """A verb's dataclass with a policy of any kind in place of a run."""
    return dataclasses.make_dataclass(f"Policy{schema.__name__}", [], bases=(PolicyConfig, schema))


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Overrides of the run's environment, and those of the verb."""
    of_env = [text for text in arguments if text.startswith("env.")]
    return of_env, [text for text in arguments if text not in of_env]


def evaluation(arguments: list[str], given: dict[str, Any]) -> EvalConfig | PolicyEvalConfig:
    """Settings of eval; without ``run`` among what is given literally, those of a policy that was not trained."""
    config: EvalConfig | PolicyEvalConfig
    if given.get("run"):
        require_run(given["run"])
        of_env, overrides = split(arguments)
        config = dataclasses.replace(compose("eval", EvalConfig, overrides), **given)
        check_of_run(given["run"], of_env)
    elif given.get("baselines"):
        raise ConfigError("--baselines stand beside a trained policy; without a run name one policy at a time")
    else:
        composed: PolicyEvalConfig = compose("eval_policy", PolicyEvalConfig, arguments)
        config = dataclasses.replace(composed, json=given.get("json", composed.json))
        check_policy(config.policy, config.env)
    for device in (config.device, *config.devices):
        check_device(device)
    if config.json not in (None, "-"):
        prove_writable(str(config.json))
    return config


def film(verb: str, arguments: list[str], given: dict[str, Any]) -> Any:
    """Settings of render and export: a run's, or with ``env`` and ``policy`` in its place, ``<verb>_policy``'s."""
    schema = FILMS[verb]
    check_ending(verb, given.get("out", ""))
    if given.get("run"):
        of_env, overrides = split(arguments)
        if given["run"].endswith(RECORDING):
            require_recording(given["run"])
            wrong = [text for text in arguments if text.startswith(("env", "policy=", "worlds=", "seed=", "device="))]
            if wrong:
                raise ConfigError(f"setting {wrong[0]!r}: {given['run']} is recorded already; it takes no such setting")
        else:
            require_run(given["run"])
        config = dataclasses.replace(compose(verb, schema, overrides), **given)
        if config.run.endswith(PLAN) and of_env:
            raise ConfigError(f"{of_env[0]}: a plan has its own environment; leave env out")
        check_of_run(config.run, of_env)
    else:
        config = dataclasses.replace(compose(f"{verb}_policy", without_run(schema), arguments), **given)
        if config.policy.endswith(PLAN):
            if any(text.startswith(("env=", "env.")) for text in arguments):
                raise ConfigError(f"policy={config.policy}: a plan has its own environment; leave env out")
            config = dataclasses.replace(config, run=config.policy)
            require_run(config.run)
        else:
            check_policy(config.policy, config.env)
    check_ending(verb, config.out)
    check_device(config.device)
    prove_writable(config.out)
    return config


def recording(arguments: list[str], given: dict[str, Any]) -> RecordConfig:
    """Settings of record."""
    config: RecordConfig = dataclasses.replace(compose("record", RecordConfig, arguments), **given)
    if not config.out.startswith(MINARI):
        if Path(config.out).suffix not in ENDINGS["record"]:
            raise ConfigError(f"out={config.out}: demonstrations need the ending .npz")
        prove_writable(config.out)
    check_policy(config.policy, config.env)
    check_device(config.device)
    return config


def viewing(arguments: list[str]) -> ViewConfig:
    """Settings of view."""
    config: ViewConfig = compose("view", ViewConfig, arguments)
    if config.policy and config.policy not in CONFIGS:
        check_policy(config.policy, config.env)
    check_device(config.device)
    return config


def playing(path: str, arguments: list[str]) -> tuple[ViewConfig, list[str]]:
    """Settings of view for a recording, a run or a plan, and overrides of the run's environment.

    Raises:
        ConfigError: If there is nothing to show, or a setting that it has itself.
    """
    place = Path(path)
    if place.suffix != RECORDING and place.suffix != PLAN:
        require_run(path)
    else:
        require_recording(path)
    of_env, overrides = split(arguments)
    wrong = [text for text in overrides if text.startswith(("env=", "policy="))]
    if wrong or (of_env and place.suffix in (RECORDING, PLAN)):
        raise ConfigError(f"setting {[*wrong, *of_env][0]!r}: {path} has its own environment and policy")
    config = viewing(overrides)
    if place.suffix not in (RECORDING, PLAN):
        check_of_run(path, of_env)
    return config, of_env


def reducing(arguments: list[str], given: dict[str, Any]) -> ReduceConfig:
    """Settings of reduce."""
    config: ReduceConfig = dataclasses.replace(compose("reduce", ReduceConfig, arguments), **given)
    if Path(config.out).suffix not in ENDINGS["reduce"]:
        raise ConfigError(f"out={config.out}: reductions need the ending .npz")
    prove_writable(config.out)
    check_policy(config.policy, config.env)
    check_device(config.device)
    return config


def preset_of(arguments: list[str]) -> list[str]:
    """The override that takes the preset of the environment and planner of plan; none where one is chosen already."""
    chosen = {"env": "cart_stem_contact", "planner": "cem"}
    chosen |= dict(text.split("=", 1) for text in arguments if "=" in text)
    name = f"{chosen['env']}_{chosen['planner']}"
    is_taken = "preset" not in chosen and name in group_options(own_packages()).get("preset", ())
    return [f"preset={name}"] if is_taken else []


def planning(arguments: list[str]) -> PlanConfig:
    """Settings of plan."""
    config: PlanConfig = compose("plan", PlanConfig, [*preset_of(arguments), *arguments])
    for device in (config.device, *config.devices):
        check_device(device)
    for path in (config.out, config.picture, config.summary):
        if path:
            prove_writable(path)
    return config


def replaying(path: str, arguments: list[str]) -> str:
    """Device on which a saved plan is carried out; nothing else can be set."""
    device = "cpu"
    for argument in arguments:
        key, _, device = argument.partition("=")
        if key != "device":
            raise ConfigError(f"setting {argument!r}: a saved plan has its settings; only device=... can be given")
    if not Path(path).is_file():
        raise ConfigError(f"plan {path} does not exist; make one with softwarp plan out={path}")
    check_device(device)
    return device


def transferring(plan: str, arguments: list[str]) -> TransferConfig:
    """Settings of transfer; ``to`` stands for the environment of the robot that follows."""
    if not Path(plan).is_file():
        raise ConfigError(f"plan {plan} does not exist; make one with softwarp plan out={plan}")
    wrong = [text for text in arguments if text.startswith(("env=", "env."))]
    if wrong:
        raise ConfigError(f"setting {wrong[0]!r}: the plan has its environment; to={wrong[0][4:]} names who follows")
    config: TransferConfig = compose("transfer", TransferConfig, [of_follower(text) for text in arguments])
    check_device(config.device)
    for path in (config.out, config.summary, config.picture):
        if path:
            prove_writable(path)
    return config


def of_follower(argument: str) -> str:
    """``to=maze`` and ``to.youngs=...`` as settings of the environment."""
    return "env" + argument[2:] if argument.startswith(("to=", "to.")) else argument


def named(arguments: list[str]) -> set[str]:
    """Options of the environment that are named among overrides of transfer."""
    return {text.partition("=")[0].removeprefix("to.") for text in arguments if text.startswith("to.")}


def require_run(path: str) -> None:
    """Refuse a run that is not there, and a folder without any checkpoint.

    Raises:
        ConfigError: Naming it.
    """
    place = Path(path)
    if path and not place.exists():
        raise ConfigError(f"run {path}: no such folder or checkpoint")
    if path and place.is_dir() and not any(any(place.glob(name)) for name in ("best.pt", "checkpoints/step_*.pt")):
        raise ConfigError(f"run {path}: the folder holds no checkpoint; softwarp list shows the runs here")


def require_recording(path: str) -> None:
    """Refuse a recording or a plan that is not there.

    Raises:
        ConfigError: Naming it.
    """
    if not Path(path).is_file():
        raise ConfigError(f"recording {path}: no such file; softwarp export ... {path} makes one")


def check_of_run(run: str, overrides: list[str]) -> None:
    """Look at settings for a run against the file that it was saved with, where that lies beside the checkpoint.

    Raises:
        ConfigError: If an override names nothing or has the wrong type.
        ValueError: If its value is out of range.
    """
    place = Path(run)
    folders = (place,) if place.is_dir() else (place.parent, place.parent.parent)
    file = next((folder / "config.yaml" for folder in folders if (folder / "config.yaml").is_file()), None)
    parse(overrides)
    if overrides and file is not None:
        saved = None
        with suppress(OSError, YAMLError, UnicodeDecodeError, OmegaConfBaseException):  # the checkpoint has them, too
            saved = OmegaConf.to_container(OmegaConf.load(file))
        if isinstance(saved, dict) and {"env", "algo"} <= set(saved):
            restore(saved, overrides)


def check_policy(policy: str, env: dict[str, Any]) -> None:
    """Refuse the name of a policy that no built-in environment has; those of own environments stand in their class.

    Raises:
        ConfigError: Naming those that there are.
    """
    name = env["name"]
    if policy != INVERSE and policy not in (*UNLEARNED, *NAMES.get(name, (policy,))) and not Path(policy).exists():
        raise ConfigError(unknown_rule(name, policy, NAMES[name]))


def check_device(device: str) -> None:
    """Refuse what is no device, and a GPU where there is no driver; whether there is this one is known later.

    Raises:
        ConfigError: Naming what there is.
    """
    if re.fullmatch(r"cpu|cuda(:\d+)?", str(device)) is None:
        raise ConfigError(f"device {device!r} is not available; devices are cpu, cuda and cuda:0, cuda:1, ...")
    if device != "cpu" and not has_driver():
        raise ConfigError(f"device {device!r} is not available; this machine has cpu (and no driver of NVIDIA's)")


def has_driver() -> bool:
    """Whether there is NVIDIA's driver; it is loaded, but no GPU is looked for."""
    for library in _DRIVERS:
        with suppress(OSError):
            ctypes.CDLL(library)
            return True
    return False


def check_ending(verb: str, out: str) -> None:
    """Refuse a file of a kind that a verb does not write.

    Raises:
        ConfigError: Naming those that it does.
    """
    if Path(out).suffix.lower() not in ENDINGS[verb]:
        raise ConfigError(f"out={out}: {verb} writes files with one of the endings {', '.join(ENDINGS[verb])}")
