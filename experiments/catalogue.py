"""``softwarp list``: what there is to train, with which settings, and the runs made here."""

import importlib.util
from collections.abc import Iterable
from pathlib import Path

from softwarp.envs import registry

CONFIG_DIR = Path(__file__).resolve().parent.parent / "hydra_configs"  # beside this folder, in a checkout and installed


def config_folders(packages: Iterable[str] = ()) -> list[Path]:
    """Where settings lie: softwarp's own, ``hydra_configs`` here, and in every package with environments and others."""
    folders = [CONFIG_DIR, Path.cwd() / CONFIG_DIR.name]
    for package in dict.fromkeys((*registry.packages(), *packages)):
        found = importlib.util.find_spec(package)
        places = found.submodule_search_locations if found is not None else None
        folders += [Path(place) / CONFIG_DIR.name for place in places or ()]
    return [folder for folder in dict.fromkeys(folder.resolve() for folder in folders) if folder.is_dir()]


def group_options(packages: Iterable[str] = ()) -> dict[str, list[str]]:
    """Choices of each group: the files of its folder among the settings, and for ``env`` the registry."""
    options = {"env": {registry.spec(name).file_name for name in registry.names()}}
    for folder in config_folders(packages):
        for file in folder.glob("*/**/*.yaml"):
            group, _, option = file.relative_to(folder).with_suffix("").as_posix().partition("/")
            options.setdefault(group, set()).add(option)
    return {group: sorted(options[group]) for group in sorted(options)}


def main() -> int:
    """Print the lists; returns the exit code."""
    print("environments")
    for name in registry.names():
        entry = registry.spec(name)
        print(f"  {name:<22}{entry.summary}  (env={entry.file_name}, Gymnasium {entry.gym_id})")
    print("  one of your own:  env=my_module:MyClass, or a package that softwarp new makes")
    folders = ", ".join(map(str, config_folders()))
    print(f"\nsettings of softwarp train and softwarp plan, from {folders} and the environments")
    for group, options in group_options().items():
        print(f"  {group:<12}{', '.join(f'{group}={option}' for option in options)}")
    runs = sorted(path.parent for path in Path("runs").glob("**/config.yaml")) if Path("runs").is_dir() else []
    print("\nruns in runs/" if runs else "\nno runs in runs/ yet; make one with: softwarp train env=trunk")
    for run in runs:
        steps = [int(path.stem.removeprefix("step_")) for path in (run / "checkpoints").glob("step_*.pt")]
        print(f"  {run}" + (f"  {max(steps):,} steps" if steps else "  no checkpoint yet"))
    return 0
