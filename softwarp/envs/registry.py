"""The table of environments: name -> class, loaded only when its class or options are asked for.

Built-in ones stand in ``TABLE``. Packages add theirs by entry points of the group ``softwarp.envs``, programs by
``register``; and ``module:class`` or ``file.py:class`` names one that nobody has registered.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import inspect
import os
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softwarp import checks
from softwarp.advice import close_to, did_you_mean, nearest

if TYPE_CHECKING:  # not a circle: base knows nothing of the table, but it loads Torch
    from softwarp.envs.base import SoftEnv
    from softwarp.envs.options.base import EnvConfig

GROUP = "softwarp.envs"  # of entry points: ``Finger = "my_package.finger:Finger"``


@dataclass(frozen=True)
class EnvSpec:
    """One line of the table: what is told before a class is loaded; all else follows from the class."""

    name: str  # what ``make`` calls it
    env: str  # ``module:class``, or ``file.py:class``
    max_episode_steps: int | None = None  # default of its options; None: these alone tell
    summary: str = ""
    config: str | None = None  # ``module:class`` of its options; None: what the class declares

    @property
    def gym_id(self) -> str:
        """Its id in Gymnasium; there is none for what nobody has registered."""
        return f"softwarp/{self.name}-v0"

    @property
    def file_name(self) -> str:
        """Its name in ``env=`` and of its files: ``CartStem`` has ``cart_stem``."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", self.name.rpartition(":")[2]).lower()

    def env_class(self) -> type[SoftEnv]:
        """The environment's class (imports Torch).

        Raises:
            ValueError: If there is no such module or class, or it is no environment.
        """
        from softwarp.envs.base import SoftEnv

        found = _imported(self.name, self.env)
        if not (inspect.isclass(found) and issubclass(found, SoftEnv)):
            raise ValueError(f"environment {self.name!r}: {self.env} is no class derived from softwarp.envs.SoftEnv")
        return found

    def config_class(self) -> type[EnvConfig]:
        """The dataclass of its options: what was registered, or what the class declares as its ``config``.

        Raises:
            ValueError: If neither names a dataclass of options.
        """
        from softwarp.envs.options.base import EnvConfig

        if self.config is not None:
            found = _imported(self.name, self.config)
        else:
            found = next((_declared(kind) for kind in self.env_class().__mro__ if _declared(kind) is not None), None)
        if not (inspect.isclass(found) and issubclass(found, EnvConfig)):
            raise ValueError(
                f"environment {self.name!r}: its options must be a dataclass derived from softwarp.envs.EnvConfig, got "
                f"{found!r}; declare it in the class as config: MyConfig, or give register(..., config=)"
            )
        return found


TABLE = {  # file in tasks/ and class in it: steps of an episode, what it is about
    "trunk:Trunk": (250, "a silicone trunk with eight cables brings its tip to a point"),
    "cart_stem:CartStem": (80, "a cart keeps a heavy sphere above it that stands on a flexible stem"),
    "cart_stem_contact:CartStemContact": (
        30,
        "a cart leans its stem on one obstacle to bring the tip behind the other",
    ),
    "cart_pole:CartPole": (80, "a cart keeps a rigid pole upright that is hinged to it"),
    "catch_the_object:CatchTheObject": (30, "two inflatable pads hold a falling ball and let it go into a moving cart"),
    "stem_pendulum:StemPendulum": (50, "a weak motor swings a soft rod up and keeps it upright"),
    "gripper:Gripper": (250, "two soft fingers on a driven hand grasp an object, lift it to a height and hold it"),
    "diamond:Diamond": (50, "a hollow silicone body with four cables brings its top to a point"),
    "bubble_motion:BubbleMotion": (20, "nine air chambers under a soft floor roll a ball to a goal"),
    "maze:Maze": (250, "a soft tripod on three servos tilts a maze so that a ball rolls to a goal"),
    "multi_gait_full:MultiGaitFull": (6, "a flat pneumatic quadruped crawls by filling and emptying its five chambers"),
    "multi_gait_reduced:MultiGaitReduced": (6, "the same quadruped in 93 modes, many times faster"),
    "simple_maze:SimpleMaze": (50, "a maze is tilted so that a ball rolls through its corridors to a goal"),
    "catheter_beam:CatheterBeam": (
        120,
        "a catheter, a guide and a coil find their way through a forking vessel to an outlet",
    ),
    "concentric_tube_robot:ConcentricTubeRobot": (50, "three concentric tubes find their way through a nasal passage"),
    "trunk_cup:TrunkCup": (250, "a trunk wrapped round a soft cup brings it to a place and an axis"),
}
ENVIRONMENTS: dict[str, EnvSpec] = {  # built in
    spec.name: spec
    for spec in (
        EnvSpec(
            place.partition(":")[2],
            f"softwarp.envs.tasks.{place}",
            *told,
            config=f"softwarp.envs.options.{place}Config",  # loads no Torch
        )
        for place, told in TABLE.items()
    )
}
_registered: dict[str, EnvSpec] = {}
_followers: list[Callable[[EnvSpec], None]] = []


def register(
    name: str,
    env: str | type[SoftEnv],
    config: str | type[EnvConfig] | None = None,
    *,
    summary: str = "",
    max_episode_steps: int | None = None,
) -> EnvSpec:
    """Make an environment known by name: to ``make``, to Gymnasium as ``softwarp/<name>-v0``, to the command line.

    A command of its own knows what its program has registered; the ``softwarp`` command knows entry points of the group
    ``softwarp.envs`` of installed packages, and takes ``env=module:class``.

    Args:
        name: A Python identifier, best that of the class.
        env: The class, or ``"module:class"``, which is imported when it is first made.
        config: Dataclass of its options, or where it is; None takes what the class declares as ``config``.
        summary: What it is about, for lists.
        max_episode_steps: Steps after which ``gymnasium.make`` ends an episode; None leaves it to the options.

    Returns:
        The line of the table.

    Raises:
        ValueError: If the name is none, or is taken by another environment.
    """
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(checks.refusal("register: name", "be a Python identifier, as of a class", name))
    if max_episode_steps is not None:
        checks.count(max_episode_steps, f"register {name}: max_episode_steps")
    where = None if config is None else _place(config, f"register {name}: config")
    entry = EnvSpec(name, _place(env, f"register {name}: env"), max_episode_steps, summary, where)
    known = _table().get(name, entry)
    if known.env != entry.env:
        raise ValueError(f"register: {name!r} is taken by {known.env}; choose another name")
    _registered[name] = entry
    for follow in _followers:
        follow(entry)
    return entry


def follow(use: Callable[[EnvSpec], None]) -> None:
    """Call ``use`` with every environment that is known, and with each that is registered later."""
    _followers.append(use)
    for entry in _table().values():
        use(entry)


def names() -> list[str]:
    """Names that ``make`` accepts: built in, of installed packages, registered."""
    return list(_table())


def spec(name: str) -> EnvSpec:
    """The table's line for ``name``; one made for it where it is ``module:class`` or ``file.py:class``.

    Raises:
        ValueError: If there is no such environment; the message lists the nearest names.
    """
    table = _table()
    if isinstance(name, str) and name not in table and ":" in name:
        return EnvSpec(name, name)
    if not isinstance(name, str) or name not in table:
        raise ValueError(f"unknown environment {name!r}; {nearest(name, table)}; module:class names one of your own")
    return table[name]


def packages() -> list[str]:
    """Installed packages that bring environments by entry points, each once."""
    return list(dict.fromkeys(entry.env.partition(":")[0].partition(".")[0] for entry in _installed().values()))


def name_of(env: type[SoftEnv]) -> str:
    """The name by which files tell an environment's class: of the table, or ``module:class``.

    Raises:
        ValueError: If the class is defined where no other program can import it.
    """
    place = _place(env, "environment")
    if env.__module__ == "__main__":
        raise ValueError(f"environment: {env.__qualname__} is defined in a program; files can name classes of modules")
    return next((name for name, entry in _table().items() if entry.env == place), place)


def _table() -> dict[str, EnvSpec]:
    return ENVIRONMENTS | _installed() | _registered


@functools.cache
def _installed() -> dict[str, EnvSpec]:
    """Environments of installed packages, none of which is imported here."""
    found: dict[str, EnvSpec] = {}
    for point in metadata.entry_points(group=GROUP):
        taken = (ENVIRONMENTS | found).get(point.name)
        if taken is not None and taken.env != point.value:
            told = f"environment {point.name!r} is {taken.env}; {point.value} has the same name and is left out"
            warnings.warn(f"{told}: use env={point.value}", stacklevel=2)
        elif not point.name.isidentifier():
            warnings.warn(
                f"entry point {point.name!r} of {GROUP} is no Python identifier and is left out", stacklevel=2
            )
        else:
            found[point.name] = EnvSpec(point.name, point.value)
    return found


def _place(thing: str | type, what: str) -> str:
    """``module:class`` of a class, or that text, checked for its form."""
    if inspect.isclass(thing):
        if "<locals>" in thing.__qualname__:
            raise ValueError(
                f"{what}: {thing.__qualname__} is defined in a function; define it where others can import it"
            )
        return f"{thing.__module__}:{thing.__qualname__}"
    if not (isinstance(thing, str) and thing.count(":") == 1 and all(thing.split(":"))):
        raise ValueError(checks.refusal(what, "be a class or 'module:class'", thing))
    return thing


def _imported(name: str, place: str) -> Any:
    """What ``module:class`` or ``file.py:class`` stands for; modules may lie in the working folder."""
    module_name, _, attribute = place.rpartition(":")
    module = _import_file(name, module_name) if module_name.endswith(".py") else _import_module(name, module_name)
    try:
        return _attribute(module, attribute)
    except AttributeError:
        classes = [key for key, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
        raise ValueError(
            f"environment {name!r}: {module_name} has no {attribute!r}; {nearest(attribute, classes)}"
        ) from None


def _declared(kind: type) -> Any:
    """The type of ``config`` in a class's own annotations, which alone is looked up; None without one."""
    note = inspect.get_annotations(kind).get("config")
    return _attribute(sys.modules[kind.__module__], note) if isinstance(note, str) else note


def _attribute(owner: Any, dotted: str) -> Any:
    return functools.reduce(getattr, dotted.split("."), owner)


def _import_module(name: str, module: str) -> Any:
    top = module.partition(".")[0]
    if top not in sys.modules and importlib.util.find_spec(top) is None and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a command that was installed looks for modules beside itself only
        importlib.invalidate_caches()
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # a module that theirs needs
        near = close_to(module, [path.stem for path in Path().glob("*.py")])
        told = f"environment {name!r}: there is no module {error.name!r}, neither installed nor in {os.getcwd()}"
        way_out = (
            did_you_mean(near) if near else "go to its folder, install its package, or write env=path/to/file.py:Class"
        )
        raise ValueError(f"{told}; {way_out}") from None


def _import_file(name: str, file: str) -> Any:
    path = Path(file).expanduser().resolve()
    if not path.is_file():
        near = close_to(path.name, [other.name for other in path.parent.glob("*.py")]) if path.parent.is_dir() else []
        advice = f"; {did_you_mean(near)}" if near else ""
        raise ValueError(f"environment {name!r}: there is no file {path}{advice}")
    present = sys.modules.get(path.stem)
    if present is None and str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
        importlib.invalidate_caches()
    module = present or importlib.import_module(path.stem)
    if getattr(module, "__file__", None) is None or Path(str(module.__file__)).resolve() != path:
        raise ValueError(
            f"environment {name!r}: {path.stem!r} is {getattr(module, '__file__', 'a built-in module')} already, not "
            f"{path}; give the file another name"
        )
    return module


def make(
    name: str,
    *,
    num_worlds: int = 1,
    device: str = "cpu",
    seed: int | None = None,
    config: EnvConfig | None = None,
    **options: Any,
) -> SoftEnv:
    """Make a batched TorchRL environment.

    Args:
        name: A name of ``names()``, for example ``"Trunk"``.
        num_worlds: How many independent worlds step together, at least 1.
        device: ``"cpu"`` or ``"cuda:0"`` and the like; simulation and tensors live there.
        seed: Seed of every random draw; None takes one from the operating system (``env.seed`` tells it).
        config: Options as a dataclass; None takes the defaults.
        **options: Single fields of the dataclass, overriding ``config``.

    Raises:
        ValueError: If the name, an option, the number of worlds or the device is not valid.
    """
    entry = spec(name)
    if seed is not None:
        checks.seed(seed)
    return entry.env_class()(
        make_config(name, config, options),
        num_worlds=check_num_worlds(num_worlds),
        device=check_device(device),
        seed=seed,
    )


def make_config(name: str, config: EnvConfig | None, options: dict[str, Any]) -> EnvConfig:
    """Options of environment ``name``: ``config`` or the defaults, with single fields replaced.

    Raises:
        ValueError: If an option is unknown (nearest names are listed) or ``config`` belongs to another environment.
    """
    cls = spec(name).config_class()
    if config is not None and not isinstance(config, cls):
        raise ValueError(f"environment {name!r}: config must be a {cls.__name__}, got {type(config).__name__}")
    valid = [field.name for field in dataclasses.fields(cls)]
    unknown = [key for key in options if key not in valid]
    if unknown:
        advice = "; ".join(f"{key!r}: {nearest(key, valid)}" for key in unknown)
        raise ValueError(f"environment {name!r} has no option {', '.join(map(repr, unknown))}; {advice}")
    return cls(**options) if config is None else dataclasses.replace(config, **options)


def check_num_worlds(num_worlds: int) -> int:
    """The number of worlds as a plain int.

    Raises:
        ValueError: If it is not an integer of at least 1.
    """
    return checks.count(num_worlds, "num_worlds")


def check_device(device: str) -> str:
    """The device's full name, ``"cpu"`` or ``"cuda:<index>"``.

    Raises:
        ValueError: If there is no such device here; the message lists those that are.
    """
    import torch

    present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    name = str(device)
    if name == "cuda" and len(present) > 1:
        name = f"cuda:{torch.cuda.current_device()}"
    if name not in present:
        raise ValueError(f"device {device!r} is not available; this machine has {', '.join(present)}")
    return name
