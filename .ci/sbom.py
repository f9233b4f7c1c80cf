"""Write a software bill of materials of this environment, CycloneDX 1.6 in JSON: ``python .ci/sbom.py [FILE]``.

Lists what softwarp asks for and all that comes with it, with versions, licences, package URLs and who needs whom. The
content depends on the environment alone, not on the time, so that two of the same environment are the same.
"""

import json
import sys
import uuid
from pathlib import Path
from typing import Any

from licences import licence
from packaging.utils import canonicalize_name
from supply import PROJECT, declared, installed


def component(name: str, version: str, told: str) -> dict[str, Any]:
    """An entry of a package; its URL is its reference."""
    url = f"pkg:pypi/{name}@{version}"
    return {
        "type": "library",
        "bom-ref": url,
        "name": name,
        "version": version,
        "purl": url,
        "licenses": [{"license": {"name": told}}],
    }


def bill(extras: tuple[str, ...] = ()) -> dict[str, Any]:
    """The document for softwarp with some of its extras."""
    packages = installed(extras)
    refs = {name: f"pkg:pypi/{name}@{package.version}" for name, package in packages.items()}
    root = component(PROJECT["name"], PROJECT["version"], PROJECT["license"]) | {"type": "application"}
    wanted = {refs[canonicalize_name(requirement.name)] for requirement in declared(extras)}
    graph = [{"ref": root["bom-ref"], "dependsOn": sorted(wanted)}]
    for name, package in packages.items():
        graph.append({"ref": refs[name], "dependsOn": [refs[need] for need in package.needs]})
    parts = [component(name, package.version, licence(name, package.about)) for name, package in packages.items()]
    serial = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps([root["purl"], *refs.values()]))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": f"urn:uuid:{serial}",
        "version": 1,
        "metadata": {"component": root},
        "components": parts,
        "dependencies": graph,
    }


if __name__ == "__main__":
    text = json.dumps(bill(), indent=1) + "\n"
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(text)
