"""``softwarp VERB --help key=value ...``: every setting with its value, its unit and range, and what it means."""

import dataclasses
import inspect
import shutil
import textwrap
import typing
from typing import Any

from softwarp.ranges import hints_of, range_of

from .comments import field_notes
from .config import TrainConfig, compose, make_env_config
from .verbs import (
    FILMS,
    EvalConfig,
    PlanConfig,
    PolicyEvalConfig,
    RecordConfig,
    ReduceConfig,
    TransferConfig,
    ViewConfig,
    without_run,
)

INDENT = 24  # columns before what a setting means


def settings(verb: str, overrides: list[str]) -> str:
    """All settings of a verb as text, with the values that ``overrides`` give them.

    Raises:
        ConfigError: If an override names nothing, with the nearest names.
    """
    composed = compose(*_schema(verb, any(text.startswith(("env=", "policy=")) for text in overrides)), overrides)
    parts: dict[str, Any] = {"": composed}
    for entry in dataclasses.fields(composed):
        value = getattr(composed, entry.name)
        if entry.name == "env":
            parts["env"] = make_env_config(value)[1]
        elif dataclasses.is_dataclass(value):
            parts[entry.name] = value
    return "\n\n".join(_group(name, part, [key for key in parts if key]) for name, part in parts.items())


def _schema(verb: str, has_no_run: bool) -> tuple[str, type]:
    """Name and dataclass of a verb's settings; some verbs have others where an environment stands in place of a run."""
    if verb == "eval" and has_no_run:
        return "eval_policy", PolicyEvalConfig
    if verb in FILMS and has_no_run:
        return f"{verb}_policy", without_run(FILMS[verb])
    schemas = {"train": TrainConfig, "eval": EvalConfig, "record": RecordConfig, "plan": PlanConfig}
    schemas |= {"transfer": TransferConfig, "reduce": ReduceConfig, "view": ViewConfig} | FILMS
    return verb, schemas[verb]


def _group(prefix: str, record: Any, groups: list[str]) -> str:
    """One dataclass: a heading, then its fields."""
    cls = type(record)
    notes, hints = notes_of(cls), hints_of(cls)
    heading = f"settings of {cls.__name__}, {prefix}.*" if prefix else "settings"
    lines = [f"{heading}:"]
    for entry in dataclasses.fields(record):
        if entry.name in groups or (prefix and entry.name == "name"):
            continue
        name = f"{prefix}.{entry.name}" if prefix else entry.name
        kind = f"{_kind(hints[entry.name])} {range_of(hints[entry.name])}".strip()
        lines += _lines(f"{name}={_text(getattr(record, entry.name))}", kind, notes.get(entry.name, ""))
    return "\n".join(lines)


def _lines(setting: str, kind: str, note: str) -> list[str]:
    """A setting, and behind or below it what it means."""
    width = max(60, min(120, shutil.get_terminal_size((100, 24)).columns)) - INDENT - 2
    told = textwrap.wrap(f"{note} ({kind})" if note else f"({kind})", width)
    first = f"  {setting}"
    if len(first) + 2 > INDENT:
        return [first, *(" " * INDENT + line for line in told)]
    return [f"{first:<{INDENT}}{told[0]}", *(" " * INDENT + line for line in told[1:])]


def notes_of(cls: type) -> dict[str, str]:
    """What the source tells of every field of a dataclass, those of its bases too."""
    notes: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if dataclasses.is_dataclass(base):
            try:
                source = textwrap.dedent(inspect.getsource(base))
            except (OSError, TypeError):  # typed into an interpreter
                continue
            told = field_notes(source)
            notes |= {name: note for name, note in told.items() if note or name not in notes}
    return notes


def _kind(hint: Any) -> str:
    """A type as one writes it, without its range."""
    if typing.get_origin(hint) is typing.Annotated:
        return _kind(typing.get_args(hint)[0])
    arguments = typing.get_args(hint)
    if typing.get_origin(hint) in (tuple, list):
        return f"[{', '.join('...' if kind is Ellipsis else _kind(kind) for kind in arguments)}]"
    if arguments:
        return " or ".join(_kind(kind) for kind in arguments)
    return "null" if hint is type(None) else getattr(hint, "__name__", str(hint))


def _text(value: Any) -> str:
    """A value as Hydra reads it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
