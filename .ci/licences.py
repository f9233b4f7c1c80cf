"""Write ``docs/licences.md`` from the metadata of installed packages: ``python .ci/licences.py``."""

import re
from importlib import metadata

from supply import ROOT, Package, declared, direct, installed

HEAD = """\
<!-- made by .ci/licences.py from the metadata of installed packages; edit that -->

# Licences of dependencies

softwarp is under the [Apache licence 2.0](../LICENSE); the READMEs of [assets](../assets) say where robots' shapes come
from. These are the packages that it asks for and those that come with them, with the licence that each tells in its
metadata ([constraints.txt](../constraints.txt) has the versions). Packages of NVIDIA come with PyTorch's build for CUDA
and are free to use but not free software; its build for CPUs does without them.
"""
PARTS = (
    ("Needed to run", "What `pip install softwarp` installs by name."),
    ("Asked for by extras", "`softwarp[video]`, `softwarp[sb3]`, `softwarp[view]` and `softwarp[dev]`."),
    ("Needed by these", "What the packages above install."),
)
LEFT = ("Left to users", "What other extras install by name; their own needs are not listed.")
# Of packages whose metadata tell none, or a whole text: read from the licence file that they bring.
TOLD = {
    "contourpy": "BSD-3-Clause",
    "cuda-toolkit": "NVIDIA, proprietary",
    "cycler": "BSD-3-Clause",
    "kiwisolver": "BSD-3-Clause",
    "matplotlib": "PSF-based (matplotlib)",
    "scipy": "BSD-3-Clause",
    "tensordict": "MIT",
    "torchrl": "MIT",
    "usd-core": "Tomorrow Open Source Technology 1.0 (modified Apache 2.0)",
}
# Of other extras, whose packages may be absent here: as their newest releases tell it.
LEFT_TO_USERS = {
    "hydra-submitit-launcher": "MIT",
    "latex2mathml": "MIT",
    "manifold3d": "Apache-2.0",
    "mlflow": "Apache-2.0",
    "minari": "MIT",
    "mkdocs-material": "MIT",
    "mkdocstrings": "ISC",
    "moviepy": "MIT",
    "mujoco-core": "Apache-2.0",
    "onnx": "Apache-2.0",
    "onnxruntime": "MIT",
    "onnxscript": "MIT",
    "pycollada": "BSD-3-Clause",
    "pytetwild": "MPL-2.0",
    "ray": "Apache-2.0",
    "skrl": "MIT",
    "wandb": "MIT",
}
LONGEST = 60  # characters of a licence field that is a name and no text


def licence(name: str, about: metadata.Distribution) -> str:
    """Licence of a package: its expression, a short name, its classifiers; ``unknown`` where it tells none."""
    told = about.metadata
    if name in TOLD:
        return TOLD[name]
    field = (told.get("License-Expression") or told.get("License") or "").strip()
    if told.get("License-Expression") or (field and len(field) <= LONGEST and "\n" not in field):
        return field.replace("LicenseRef-NVIDIA-Proprietary", "NVIDIA, proprietary")
    classes = [text for text in told.get_all("Classifier") or [] if text.startswith("License ::")]
    return ", ".join(re.sub(r" License$", "", text.rpartition(" :: ")[2]) for text in classes) or "unknown"


def rows(packages: dict[str, Package], names: set[str]) -> list[str]:
    """Lines of a table for some of the packages."""
    lines = ["| package | licence |", "|---|---|"]
    return lines + [f"| {p.name} | {licence(name, p.about)} |" for name, p in packages.items() if name in names]


def page() -> str:
    """The page."""
    packages = installed()
    run = {name for name in packages if name in {r.name.lower().replace("_", "-") for r in declared()}}
    groups = (run, direct() - run, set(packages) - direct())
    parts = [HEAD]
    for (title, about), names in zip(PARTS, groups, strict=True):
        parts += [f"## {title}", "", about, "", *rows(packages, names), ""]
    title, about = LEFT
    parts += [f"## {title}", "", about, "", "| package | licence |", "|---|---|"]
    parts += [*(f"| {name} | {told} |" for name, told in LEFT_TO_USERS.items()), ""]
    return "\n".join(parts)


if __name__ == "__main__":
    (ROOT / "docs" / "licences.md").write_text(page(), encoding="utf-8")
    print("docs/licences.md written")
