"""Write the pages that are made from source: ``python docs/generate.py``, or ``--check`` to only compare.

``environments/<name>.md`` comes from the registry, the environment's docstring and its configuration class, with what
``paper()`` of that class changes;
``concepts/arrays.md`` comes from the declarations of the models, ``State``, ``Control`` and ``Parameters``. The table
between the throughput marks of ``README.md`` and ``performance.md`` comes from ``benchmarks/results/*.json``, those
between the peers and capture marks of ``performance.md`` from ``peers.json`` and ``capture.json`` there.
The sources are parsed, not imported, so this needs nothing but Python.
"""

import ast
import itertools
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))

from experiments.comments import attribute_notes, trailing_comment  # noqa: E402

NOTE = "<!-- made by docs/generate.py from {source}; edit that -->"


ARRAYS_INTRODUCTION = """\
Shapes are those seen from Python; [data.md](data.md) says how they lie in memory. The unit is left out where there is
none. Frames are the rigid bodies, then the nodes of all rods: `sim.body_pose`, `body_twist`, `rod_x`, `rod_q`, `rod_v`
and `rod_w` are parts of `frame_pose` and `frame_twist`, `control.body_force` and `rod_force` of
`control.frame_force`."""


@dataclass(frozen=True)
class Option:
    """One field of a configuration class."""

    name: str
    kind: str
    default: str
    comment: str


def module_path(dotted: str) -> Path:
    """File of a module below the repository."""
    path = ROOT / Path(*dotted.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def options(dotted: str) -> list[Option]:
    """Fields of a configuration class, those of its base classes first; ``dotted`` is ``module:class``."""
    module, _, name = dotted.partition(":")
    path = module_path(module)
    lines = path.read_text(encoding="utf-8").splitlines()
    tree = ast.parse("\n".join(lines))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    origin = {
        alias.asname or alias.name: f"{node.module}:{alias.name}"
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("softwarp")
        for alias in node.names
    }
    fields: dict[str, Option] = {}
    for base in classes[name].bases:
        inherited = ast.unparse(base)
        home = f"{module}:{inherited}" if inherited in classes else origin[inherited]
        fields |= {option.name: option for option in options(home)}
    documented = attribute_notes(classes[name])
    for node in classes[name].body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            default = ast.unparse(node.value) if node.value is not None else "required"
            comment = documented.get(node.target.id) or trailing_comment(lines, node)
            kind = plain_type(ast.unparse(node.annotation))
            fields[node.target.id] = Option(node.target.id, kind, default, comment)
    return list(fields.values())


def paper_options(dotted: str) -> dict[str, str]:
    """What a configuration class's ``paper()`` sets, by option; ``dotted`` is ``module:class``."""
    module, _, name = dotted.partition(":")
    tree = ast.parse(module_path(module).read_text(encoding="utf-8"))
    [config] = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name]
    for method in config.body:
        if isinstance(method, ast.FunctionDef) and method.name == "paper":
            [values] = [node.value for node in method.body if isinstance(node, ast.AnnAssign)]
            assert isinstance(values, ast.Dict), f"{dotted}.paper has no dictionary of options"
            return {
                ast.literal_eval(key): ast.unparse(value)
                for key, value in zip(values.keys, values.values, strict=True)
                if key is not None
            }
    return {}


def option_kinds() -> dict[str, tuple[str, str]]:
    """Type and range of every kind of number that ``envs/options`` declares, by its name."""
    kinds: dict[str, tuple[str, str]] = {}
    for node in ast.parse(module_path("softwarp.envs.options").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript):
            base, limits = node.value.slice.elts  # type: ignore[attr-defined]
            given = {key.arg: ast.unparse(key.value) for key in limits.keywords}
            low = f"({given['above']}" if "above" in given else f"[{given['low']}" if "low" in given else "(-inf"
            high = f"{given['below']})" if "below" in given else f"{given['high']}]" if "high" in given else "inf)"
            if "infinite" in given:
                high = high.replace("inf)", "inf]")
                low = low.replace("(-inf", "[-inf")
            told = f"{low}, {high}".replace("math.", "").replace("_", "")
            told = re.sub(r"\d[\d.e-]*", lambda number: f"{float(number[0]):g}", told)
            kinds[node.targets[0].id] = (ast.unparse(base), told)  # type: ignore[attr-defined]
    return kinds


def plain_type(annotation: str) -> str:
    """An annotation with kinds of numbers written out: their type, and the range that values lie in."""
    ranges = []
    for name, (base, told) in option_kinds().items():
        if re.search(rf"\b{name}\b", annotation):
            annotation = re.sub(rf"\b{name}\b", base, annotation)
            ranges.append(f" in {told}")
    return annotation + "".join(ranges)


def registry_table() -> list[dict[str, str]]:
    """The lines of the registry's ``TABLE`` and what follows from each class."""
    tree = ast.parse(module_path("softwarp.envs.registry").read_text(encoding="utf-8"))
    [table] = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "TABLE"
    ]
    return [environment_entry(place, *told) for place, told in ast.literal_eval(table).items()]


def environment_entry(place: str, steps: int, summary: str) -> dict[str, str]:
    """What the pages tell about an environment; ``place`` is its file in ``tasks/`` and its class in it."""
    file, _, name = place.partition(":")
    module = f"softwarp.envs.tasks.{file}"
    body = ast.parse(module_path(module).read_text(encoding="utf-8")).body
    [task] = [node for node in body if isinstance(node, ast.ClassDef) and node.name == name]
    declared = {ast.unparse(node.target): node.annotation for node in task.body if isinstance(node, ast.AnnAssign)}
    return {
        "name": name,
        "env": f"{module}:{name}",
        "config": f"softwarp.envs.options.{file}:{ast.unparse(declared['config'])}",
        "gym_id": f"softwarp/{name}-v0",
        "max_episode_steps": str(steps),
        "summary": summary,
    }


def cell(text: str) -> str:
    """Text that may stand in a cell of a Markdown table."""
    return text.replace("|", r"\|").replace("``", "`")


def picture(entry: dict[str, str]) -> list[str]:
    """Lines that show the environment, if there are a picture and a film of its name."""
    name = page_name(entry).removesuffix(".md")
    shown = (("png", "an episode of the hand-written policy"), ("gif", "a film of an episode"))
    files = [(f"{name}.{kind}", told) for kind, told in shown]
    lines = [f"![{entry['name']}: {told}](../images/{f})" for f, told in files if (DOCS / "images" / f).is_file()]
    return [*lines, ""] if lines else []


def described(body: str) -> list[str]:
    """The body of an environment's docstring as Markdown: its terms as a table, then its paragraphs."""
    head, *paragraphs = re.split(r"\n\s*\n", body.strip("\n"))
    terms: list[tuple[str, list[str]]] = []
    column = 0
    for line in head.splitlines():
        if line.startswith(" "):
            terms[-1][1].append(line[column:])
        else:
            name, _, told = line.partition("  ")
            terms.append((name, [told.strip()]))
            column = line.index(terms[-1][1][0])
    width = max(map(len, head.splitlines()))
    rows = [f"| {name} | {'<br>'.join(cell(line) for line in sentences(lines, width))} |" for name, lines in terms]
    joined = [one_line(paragraph).replace("``", "`") for paragraph in paragraphs]
    return ["| | |", "|---|---|", *rows, "", *(line for text in joined for line in (text, ""))]


def sentences(lines: list[str], width: int) -> list[str]:
    """Lines joined where they were wrapped: not before a label, nor where the next word would have had room."""
    indent = width - max(map(len, lines))
    told = [lines[0]]
    for before, line in itertools.pairwise(lines):
        room = indent + len(before) + 1 + len(line.split()[0]) <= width
        meant = re.match(r"[a-z]+( \(.*\))?: ", line) or (room and not line.startswith(" "))
        told = [*told, line] if meant else [*told[:-1], one_line(f"{told[-1]}\n{line}")]
    return [one_line(sentence) for sentence in told]


def one_line(text: str) -> str:
    """Text without its line breaks, one within a path among them."""
    return " ".join(re.sub(r"(?<=\w/)\n\s*", "", text).split())


def environment_page(entry: dict[str, str]) -> str:
    """One environment: what its docstring says, and all options."""
    module = entry["env"].partition(":")[0]
    path = module_path(module)
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    title, _, body = docstring.partition("\n")
    source = path.relative_to(ROOT).as_posix()
    rows = [
        f"| `{option.name}` | `{cell(option.kind)}` | `{cell(option.default)}` | {cell(option.comment)} |"
        for option in options(entry["config"])
    ]
    return "\n".join(
        [
            NOTE.format(source=source),
            "",
            f"# {entry['name']}",
            "",
            title.strip(),
            "",
            f'`softwarp.make("{entry["name"]}", num_worlds=..., device=..., seed=..., **options)`, '
            f'`gymnasium.make("{entry["gym_id"]}")`. Source: [{path.name}](../../{source}).',
            "",
            *picture(entry),
            *described(body),
            "## Options",
            "",
            "| option | type | default | meaning |",
            "|---|---|---|---|",
            *rows,
            "",
            *beside_sofagym(entry["name"], entry["config"]),
        ]
    )


def beside_sofagym(task: str, dotted: str) -> list[str]:
    """What SofaGym's settings are, for the page of an environment that has them."""
    theirs, declared = paper_options(dotted), {option.name: option for option in options(dotted)}
    if not theirs:
        return []
    name = dotted.rpartition(":")[2]
    rows = [
        f"| `{key}` | `{cell(declared[key].default)}` | `{cell(value)}` | {cell(declared[key].comment)} |"
        for key, value in theirs.items()
    ]
    return [
        "## Beside SofaGym",
        "",
        f'`softwarp.make("{task}", config=softwarp.envs.{name}.paper())` changes these options and no others; what '
        "else is the same and what is mended for all: [coming from SofaGym](../coming_from_sofa.md#environments).",
        "",
        "| option | ours | SofaGym's | meaning |",
        "|---|---|---|---|",
        *rows,
        "",
    ]


def environment_index(entries: list[dict[str, str]]) -> str:
    """The list of environments."""
    rows = []
    for entry in entries:
        link = f"[{entry['name']}]({page_name(entry)})"
        rows.append(f"| {link} | `{entry['gym_id']}` | {entry['max_episode_steps']} | {entry['summary']} |")
    head = "| name | Gymnasium id | steps per episode | task |\n|---|---|---|---|"
    return "\n".join([NOTE.format(source="softwarp/envs/registry.py"), "", "# Environments", "", head, *rows, ""])


def declared_arrays(path: Path) -> dict[str, list[dict[str, str]]]:
    """Declarations made with ``shared``, ``batched`` and ``scratch`` in a file, by class."""
    tables: dict[str, list[dict[str, str]]] = {}
    for group in ast.parse(path.read_text(encoding="utf-8")).body:
        if not isinstance(group, ast.ClassDef):
            continue
        for node in group.body:
            call = node.value if isinstance(node, ast.AnnAssign) else None
            if isinstance(call, ast.Call) and ast.unparse(call.func) in ("shared", "batched", "scratch"):
                words = {word.arg: text(word.value) for word in call.keywords if word.arg}
                words |= {"width": text(call.args[1])} if len(call.args) > 1 else {}
                words |= {"name": ast.unparse(node.target), "item": ast.literal_eval(call.args[0])}
                tables.setdefault(group.name, []).append(words | {"kind": ast.unparse(call.func)})
    return tables


def text(node: ast.expr) -> str:
    """A constant without quotes, or the source of another expression."""
    return str(node.value) if isinstance(node, ast.Constant) else ast.unparse(node).rpartition(".")[2]


def axes(row: dict[str, str]) -> list[str]:
    """Logical axes of a declared array; a batched one has ``width`` rows for every item."""
    item, width = row["item"], row.get("width", "1")
    if row["kind"] == "shared":
        return [item, "..."]
    rows = [] if item == "world" else [item]
    return ["world", *rows, *([] if width == "1" else [width])]


def arrays_page() -> str:
    """All arrays of the data containers with shape and unit."""
    folder = ROOT / "softwarp" / "model"
    whole, state = folder / "model.py", folder / "state.py"
    records = [path for path in sorted(folder.glob("*.py")) if path not in (whole, state) and declared_arrays(path)]
    paths = [whole, *records, state, ROOT / "softwarp" / "solvers" / "workspace" / "workspace.py"]
    source = ", ".join(path.relative_to(ROOT).as_posix() for path in paths)
    parts = [NOTE.format(source=source), "", "# Arrays", "", ARRAYS_INTRODUCTION]
    for path in paths:
        for name, rows in declared_arrays(path).items():
            parts += ["", f"## {name}", "", "| array | shape | unit | meaning |", "|---|---|---|---|"]
            for row in rows:
                shape = "(" + ", ".join(axes(row)) + ")"
                unit = row.get("unit", "1")
                parts.append(
                    f"| `{row['name']}` | {shape} | {'' if unit == '1' else unit} | {cell(row.get('doc', ''))} |"
                )
    return "\n".join([*parts, ""])


def page_name(entry: dict[str, str]) -> str:
    """File name of an environment's page: that of its module."""
    return entry["env"].partition(":")[0].rpartition(".")[2] + ".md"


def throughput_table() -> str:
    """Recorded benchmark results, one row for each number of worlds on each machine."""
    rows = []
    for path in sorted((ROOT / "benchmarks" / "results").glob("*.json")):
        records = json.loads(path.read_text(encoding="utf-8"))
        other = {"engine", "figure", "capture"}
        timed = [record for record in records if "ms_per_step" in record and not other & set(record)]
        rows += [throughput_row(path.stem, record) for record in timed]
    if not rows:
        return "No results are recorded in `benchmarks/results` yet."
    head = "| scene | nodes | hardware | worlds | ms per step | world-steps/s | commit |\n|---|---|---|---|---|---|---|"
    return "\n".join([head, *rows])


def throughput_row(scene: str, record: dict[str, Any]) -> str:
    """One record as written by a benchmark with ``--json``; ``hardware`` and ``scene`` may be added to it by hand."""
    hardware = record.get("hardware") or f"{record['device']}, {record['processor']}"
    values = (
        record.get("scene", scene),
        record["nodes"],
        hardware,
        record["worlds"],
        f"{record['ms_per_step']:.3g}",
        f"{record['world_steps_per_s']:,.0f}".replace(",", " "),
        f"`{record['commit']}`",
    )
    return "| " + " | ".join(cell(str(value)) for value in values) + " |"


def peers_table() -> str:
    """Recorded comparison with other simulators."""
    path = ROOT / "benchmarks" / "results" / "peers.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    if not records:
        return "No comparison is recorded in `benchmarks/results` yet."
    head = "| simulator | settings | hardware | worlds | ms per step | world-steps/s | softwarp is | sag | |"
    return "\n".join([head, "|---|---|---|---|---|---|---|---|---|", *map(peers_row, records)])


def peers_row(record: dict[str, Any]) -> str:
    """One record of ``softwarp bench peers``."""
    time = record["ms_per_step"]
    values = (
        f"{record['engine']} {record['version']}",
        record["settings"],
        record["hardware"],
        record["worlds"],
        f"{time:.3g}" if time < 1e3 else f"{time:,.0f}".replace(",", " "),
        f"{record['world_steps_per_s']:,.0f}".replace(",", " "),
        "" if record["engine"] == "softwarp" else f"{record['times_softwarp']:.1f} times faster",
        f"{record['sag_mm']:.1f} mm",
        record["note"],
    )
    return "| " + " | ".join(cell(str(value)) for value in values) + " |"


def capture_table() -> str:
    """Recorded environment steps, as parts and as one graph side by side."""
    path = ROOT / "benchmarks" / "results" / "capture.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    if not records:
        return "No steps are recorded in `benchmarks/results` yet."
    times = {(record["task"], record["worlds"], record["capture"]): record for record in records}
    head = "| environment | hardware | worlds | parts launched, `capture=False` | one graph | host | commit |"
    rows = [
        f"| {task} | {parts['hardware']} | {worlds} | {parts['ms_per_step']:.3g} | "
        f"{times[task, worlds, True]['ms_per_step']:.3g} | {times[task, worlds, True]['host_ms']:.2g} | "
        f"`{parts['commit']}` |"
        for (task, worlds, is_captured), parts in times.items()
        if not is_captured
    ]
    return "\n".join([head, "|---|---|---|---|---|---|---|", *rows])


def with_table(path: Path, name: str, table: str, text: str | None = None) -> str:
    """A hand-written page with the table between the marks of a name renewed; ``text`` instead of the file's."""
    marks = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
    text = path.read_text(encoding="utf-8") if text is None else text
    if not marks.search(text):
        raise ValueError(f"{path}: the lines <!-- {name} --> and <!-- end {name} --> are missing; put them back")
    return marks.sub(lambda match: match[1] + table + "\n" + match[2], text)


def pages() -> dict[Path, str]:
    """Every generated page and its text."""
    entries = registry_table()
    folder = DOCS / "environments"
    result = {folder / page_name(entry): environment_page(entry) for entry in entries}
    result[folder / "README.md"] = environment_index(entries)
    result[DOCS / "concepts" / "arrays.md"] = arrays_page()
    for path in (ROOT / "README.md", DOCS / "performance.md"):
        result[path] = with_table(path, "throughput", throughput_table())
    result[path] = with_table(path, "peers", peers_table(), result[path])
    result[path] = with_table(path, "capture", capture_table(), result[path])
    return result


def main() -> int:
    """Write the pages, or with ``--check`` name those that differ; exit status 1 if there are any."""
    if sys.argv[1:] not in ([], ["--check"]):
        print("usage: python docs/generate.py [--check]")
        return 2
    made = pages()
    stale = [path for path, text in made.items() if not path.exists() or path.read_text(encoding="utf-8") != text]
    stale += [path for path in (DOCS / "environments").glob("*.md") if path not in made]
    if sys.argv[1:] == ["--check"]:
        for path in stale:
            print(f"{path.relative_to(ROOT)} is out of date: run python docs/generate.py")
        return 1 if stale else 0
    for path in stale:
        if path in made:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(made[path], encoding="utf-8")
        else:
            path.unlink()
        print(f"{path.relative_to(ROOT)} {'written' if path in made else 'removed'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
