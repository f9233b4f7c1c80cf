"""What pyproject.toml promises to install is what the repository holds."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_is_listed():
    """A folder with an ``__init__.py`` that the list misses would be left out of the wheel without a word."""
    found = {".".join(init.parent.relative_to(ROOT).parts) for init in (ROOT / "softwarp").rglob("__init__.py")}
    found |= {
        f"softwarp.{folder}"
        for folder in ("benchmarks", "experiments", "hydra_configs")
        if (ROOT / folder / "__init__.py").exists()
    }
    assert set(SETTINGS["tool"]["setuptools"]["packages"]) == found


def test_every_data_file_is_matched():
    """Files other than Python inside the packages are covered by a package-data pattern."""
    folders = {name: name.replace(".", "/") for name in SETTINGS["tool"]["setuptools"]["packages"]}
    folders |= SETTINGS["tool"]["setuptools"]["package-dir"]
    patterns = SETTINGS["tool"]["setuptools"]["package-data"]
    covered = {path for name, globs in patterns.items() for glob in globs for path in (ROOT / folders[name]).glob(glob)}
    held = {path for folder in ("softwarp", "experiments", "hydra_configs") for path in (ROOT / folder).rglob("*")}
    data = {path for path in held if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert data <= covered, f"not installed: {sorted(str(path.relative_to(ROOT)) for path in data - covered)}"


def test_version_is_told_once():
    """The package, its citation and its changelog name the same version."""
    version = SETTINGS["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {version}" in (ROOT / "CHANGELOG.md").read_text()
