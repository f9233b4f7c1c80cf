"""The ``softwarp`` command: one short function per verb, which hands over to ``experiments/`` or ``benchmarks/``.

Settings are ``key=value`` pairs that Hydra composes; an option such as ``--json`` is shorthand for one.
Exit codes: 0 done, 1 a check failed or a file could not be written, 2 bad input, 128 + n stopped by signal n.
"""

import argparse
import contextlib
import importlib
import importlib.util
import os
import sys
import sysconfig
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TextIO

from softwarp import advice, notices, processes
from softwarp.io.atomic import DISK_ERRORS, WriteError

CANNOT_WRITE = 1
BAD_INPUT = 2
ROOT = Path(__file__).resolve().parent.parent  # of a checkout; site-packages where installed


def experiment(name: str) -> ModuleType:
    """A script of ``experiments/``."""
    return script("experiments", name)


def script(folder: str, name: str) -> ModuleType:
    """A script of a folder that is installed as a package of softwarp, and stands beside it in a checkout."""
    package = f"softwarp.{folder}"
    if package not in sys.modules and importlib.util.find_spec(package) is None:
        place = ROOT / folder
        spec = importlib.util.spec_from_file_location(
            package, place / "__init__.py", submodule_search_locations=[str(place)]
        )
        if spec is None or spec.loader is None or not place.is_dir():
            raise ModuleNotFoundError(f"{package}: found neither installed nor in {place}; reinstall softwarp")
        module = importlib.util.module_from_spec(spec)
        sys.modules[package] = module
        spec.loader.exec_module(module)
    return importlib.import_module(f"{package}.{name}")


def hydra_job(composed: Any) -> int:
    """One run of a Hydra sweep; it stands here because launchers such as submitit's look it up by its module's name."""
    return _code(experiment("train").job(composed))


TRAIN_HELP = """Train a policy: softwarp train env=trunk algo=ppo [key=value ...].
softwarp list shows what to choose from; -m seed=0,1,2 makes a sweep."""


def train(arguments: list[str]) -> int:
    """Train a policy, or go on with a stopped run."""
    parser = _parser("train", TRAIN_HELP)
    parser.add_argument("--resume", metavar="RUN", help="run folder or checkpoint to go on with")
    known, overrides = parser.parse_known_args(arguments)
    experiment("early").train(overrides, known.resume)
    return _code(experiment("train").main(overrides, resume=known.resume, one_job=hydra_job))


EVAL_HELP = """Test a policy on unseen goals: a trained one, softwarp eval RUN,
or softwarp eval env=diamond policy=inverse."""


def evaluate(arguments: list[str]) -> int:
    """Test a policy on unseen goals: a trained one, a hand-written one, inverse control."""
    parser = _parser("eval", EVAL_HELP)
    parser.add_argument("run", metavar="RUN_OR_CHECKPOINT")
    parser.add_argument("--baselines", action="store_true", help="also do nothing, random actions, a hand-written rule")
    parser.add_argument("--json", nargs="?", const="-", metavar="FILE", help="write JSON (no FILE: print it)")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="episodes=64 seed=... env.youngs=300e3 ...")
    known = parser.parse_intermixed_args(arguments)
    is_setting = "=" in known.run and not Path(known.run).exists()  # no run, but settings that say which policy
    given: dict[str, Any] = {"run": "" if is_setting else known.run}
    if is_setting:
        known.overrides.insert(0, known.run)
    if known.baselines:
        given["baselines"] = True
    if known.json:
        given["json"] = known.json
    experiment("early").evaluate(known.overrides, given)
    return _code(experiment("eval").main(known.overrides, given))


FILM_HELP = """RUN is a run folder, a checkpoint, a plan file or a recording (.npz); instead of it
env=diamond policy=inverse names an environment and a policy: inverse (control), a hand-written one by its name,
or a trained one by its folder."""


def render(arguments: list[str]) -> int:
    """Film a policy or a plan: .mp4, .gif or .png."""
    return _film("render", arguments)


def view(arguments: list[str]) -> int:
    """Show a running robot in the browser, to be driven there, or a recording."""
    parser = _parser(
        "view",
        "Live in the browser: softwarp view env=trunk policy=scripted worlds=4 [key=value ...]. "
        "A recording (.npz), a plan (.json) or an episode of a run: softwarp view FILE_OR_RUN [key=value ...].",
    )
    parser.add_argument(
        "words", nargs="*", metavar="RECORDING|key=value", help="policy=inverse speed=0.5 port=8080 ..."
    )
    words = parser.parse_args(arguments).words
    paths = [word for word in words if "=" not in word or Path(word).exists()]
    if len(paths) > 1:
        raise ValueError(f"give one recording, plan or run to look at; got {' '.join(paths)}")
    path, overrides = "".join(paths), [word for word in words if word not in paths]
    experiment("early").view(overrides, path)
    return _code(experiment("view").main(overrides, path))


def export(arguments: list[str]) -> int:
    """Write the motion of a policy or a plan as a USD scene or a page that plays (.html)."""
    return _film("export", arguments)


def _film(verb: str, arguments: list[str]) -> int:
    parser = _parser(verb, f"{VERBS[verb].__doc__} {FILM_HELP}")
    parser.add_argument("words", nargs="+", metavar="RUN FILE key=value", help="worlds=4 seed=... env.youngs=300e3 ...")
    known = parser.parse_intermixed_args(arguments)
    words = [word.removeprefix("out=") for word in known.words]  # a file may be given as other settings are
    overrides = [word for word in words if "=" in word and not Path(word).exists()]
    names = [word for word in words if word not in overrides]
    if len(names) > 2 or len(names) == 0:
        raise ValueError(f"give a run and a file to write, or env=... policy=... and a file; got {' '.join(words)}")
    given = {"out": names[-1]} | ({"run": names[0]} if len(names) == 2 else {})
    if len(names) == 1 and not any(word.startswith(("env=", "policy=")) for word in overrides):
        raise ValueError(f"{names[0]}: give a run and a file to write, or env=... policy=... and a file")
    experiment("early").film(verb, overrides, given)
    return _code(experiment(verb).main(overrides, given))


def record(arguments: list[str]) -> int:
    """Record demonstrations to learn from."""
    parser = _parser("record", "Record episodes of a hand-written or trained policy for behaviour cloning.")
    parser.add_argument("out", metavar="FILE.npz|minari:NAME", type=lambda text: text.removeprefix("out="))
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="env=cart_stem policy=scripted episodes=100")
    known = parser.parse_args(arguments)
    experiment("early").record(known.overrides, {"out": known.out})
    return _code(experiment("record").main(known.overrides, {"out": known.out}))


def reduce(arguments: list[str]) -> int:
    """Reduce a robot's body to some dozens of modes."""
    parser = _parser(
        "reduce", "Learn modes and elements from motion: softwarp reduce env=diamond diamond.npz modes=32."
    )
    parser.add_argument("words", nargs="+", metavar="FILE.npz key=value", help="env=diamond policy=random ...")
    known = parser.parse_args(arguments)
    words = [word.removeprefix("out=") for word in known.words]
    names = [word for word in words if "=" not in word]
    if len(names) != 1:
        raise ValueError(f"give one file to write, out=FILE.npz; got {' '.join(words)}")
    overrides = [word for word in words if "=" in word]
    experiment("early").reduce(overrides, {"out": names[0]})
    return _code(experiment("reduce").main(overrides, {"out": names[0]}))


def policy(arguments: list[str]) -> int:
    """Write a trained policy to one file for robots (.onnx, .pt2), or time it."""
    return _code(experiment("policy").main(arguments))


def plan(arguments: list[str]) -> int:
    """Search for actions that reach the goal, in exact copies of the state."""
    parser = _parser(
        "plan",
        "Plan for an environment: softwarp plan env=cart_stem_contact planner=cem out=plan.json [key=value ...]; "
        "softwarp plan --cfg job planner=opd shows all settings",
    )
    parser.add_argument("--replay", metavar="PLAN.json", help="carry a saved plan out and compare every state")
    parser.add_argument("--cfg", choices=["job"], help="show all settings with their values, and do nothing")
    known, overrides = parser.parse_known_args(arguments)
    if known.cfg:
        print(experiment("plan").describe(overrides), end="")
        return 0
    experiment("early").plan(overrides, known.replay)
    return _code(experiment("plan").main(overrides, replay=known.replay))


def transfer(arguments: list[str]) -> int:
    """Turn a plan into commands of another robot, replay them, and write them to a file."""
    parser = _parser(
        "transfer",
        "Let another robot follow a plan: softwarp transfer plan.json to=maze out=servos.csv [key=value ...]",
    )
    parser.add_argument("plan", metavar="PLAN.json")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="to=maze to.youngs=300e3 replays=64 ...")
    known = parser.parse_args(arguments)
    experiment("early").transfer(known.plan, known.overrides)
    return _code(experiment("transfer").main(known.plan, known.overrides))


def show_list(arguments: list[str]) -> int:
    """Show environments, algorithms, settings and runs."""
    _parser("list", show_list.__doc__ or "").parse_args(arguments)
    return _code(experiment("catalogue").main())


def doctor(arguments: list[str]) -> int:
    """Check this installation and machine."""
    _parser("doctor", doctor.__doc__ or "").parse_args(arguments)
    return _code(experiment("doctor").main())


def demo(arguments: list[str]) -> int:
    """Train the trunk for some minutes, test it, draw and export it."""
    parser = _parser("demo", demo.__doc__ or "")
    parser.add_argument("out", nargs="?", default="softwarp-demo", metavar="FOLDER")
    parser.add_argument("--minutes", type=float, default=None, help="training time; default 4")
    known, overrides = parser.parse_known_args(arguments)
    if "=" in known.out:  # a setting of the training, without a folder
        known.out, overrides = parser.get_default("out"), [known.out, *overrides]
    experiment("early").demo(known.out, known.minutes, overrides)
    return _code(experiment("demo").main(known.out, known.minutes, overrides))


def baselines(arguments: list[str]) -> int:
    """Train tasks x algorithms x seeds; curves and a table."""
    return _code(experiment("baselines").main(arguments))


def sweep(arguments: list[str]) -> int:
    """Train many settings, side by side or over machines; one table."""
    return _code(experiment("sweep").main(arguments))


def paper(arguments: list[str]) -> int:
    """SofaGym's figures and tables beside ours, on one page."""
    return _code(experiment("paper").main(arguments))


def warm(arguments: list[str]) -> int:
    """Compile the kernels of environments ahead of time."""
    return _code(experiment("warm").main(arguments, compile_for))


def compile_for(*given: Any) -> float:
    """Compile one environment's kernels, in a process of ``warm``, which finds ``experiments/`` as this one does."""
    seconds: float = experiment("warm").compile_for(*given)
    return seconds


def new(arguments: list[str]) -> int:
    """Write a package with a robot of your own, which runs as it is."""
    return _code(experiment("new").main(arguments))


def bench(arguments: list[str]) -> int:
    """Time every scene on this machine, or compare with other simulators."""
    return _code(script("benchmarks", "run").main(arguments))


def validate(arguments: list[str]) -> int:
    """Compare with measured silicone, beside published simulators."""
    return _code(experiment("validate").main(arguments))


def identify(arguments: list[str]) -> int:
    """Find physical parameters from measurements."""
    return _code(experiment("identify").main(arguments))


VERBS: dict[str, Callable[[list[str]], int]] = {
    "new": new,
    "train": train,
    "eval": evaluate,
    "render": render,
    "view": view,
    "export": export,
    "record": record,
    "reduce": reduce,
    "policy": policy,
    "plan": plan,
    "transfer": transfer,
    "demo": demo,
    "baselines": baselines,
    "sweep": sweep,
    "paper": paper,
    "list": show_list,
    "doctor": doctor,
    "bench": bench,
    "validate": validate,
    "identify": identify,
    "warm": warm,
}


SETTINGS = (
    "train",
    "eval",
    "render",
    "view",
    "export",
    "record",
    "reduce",
    "plan",
    "transfer",
)  # verbs whose help lists what can be set


def _explain(verb: str, overrides: list[str]) -> int:
    """Help of a verb, then all its settings, as the given ones leave them."""
    with contextlib.suppress(SystemExit):
        VERBS[verb](["--help"])
    sys.stdout.flush()
    print(f"\n{experiment('describe').settings(verb, overrides)}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        try:
            return _run(given)
        finally:
            if not sys.stdout.closed:
                sys.stdout.flush()  # here, where a reader who has seen enough can be told from an error
    except BrokenPipeError:  # such as head
        _silence(sys.stdout)
        return 0
    except OSError as error:
        _silence(sys.stdout)
        return _fail(str(WriteError.of(Path("standard output"), error)), code=CANNOT_WRITE)


def _run(given: list[str]) -> int:
    """One verb, or what is told without one."""
    if not given or given[0] in ("-h", "--help"):
        print(_usage())
        return 0 if given else BAD_INPUT
    if given[0] == "--version":
        from importlib import metadata

        print(metadata.version("softwarp"))
        return 0
    verb, rest = given[0], given[1:]
    if verb not in VERBS:
        near = advice.close_to(verb, VERBS, count=2)
        return _fail(f"there is no {verb!r}; " + (f"did you mean {' or '.join(near)}?" if near else _usage()))
    try:
        processes.end_with_parent()
        processes.end_with_launcher()
        if verb in SETTINGS and {"-h", "--help"} & set(rest):
            return _explain(verb, [word for word in rest if "=" in word])
        with warnings.catch_warnings(), processes.hearing_interrupts(verb), notices.telling():
            warnings.showwarning = _show_warning
            code = VERBS[verb](rest)
            sys.stdout.flush()
            return code
    except KeyboardInterrupt:
        return _fail(f"{verb}: interrupted", code=130)
    except BrokenPipeError:
        raise
    except WriteError as error:
        return _fail(f"{verb}: {error}", code=CANNOT_WRITE)
    except (ValueError, OSError, ImportError, FloatingPointError, MemoryError) as error:
        if os.environ.get("SOFTWARP_TRACEBACK"):
            traceback.print_exc()
        if isinstance(error, OSError) and error.filename is None and error.errno in DISK_ERRORS:  # what was printed
            _silence(sys.stdout)
            return _fail(f"{verb}: {WriteError.of(Path('standard output'), error)}", code=CANNOT_WRITE)
        return _fail(f"{verb}: {_reason(error)}{_own_place(error)}")


def _parser(verb: str, description: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(prog=f"softwarp {verb}", description=description, allow_abbrev=False)


def _code(value: Any) -> int:
    return int(value)


def _usage() -> str:
    verbs = "\n".join(f"  {name:<11}{(verb.__doc__ or '').splitlines()[0]}" for name, verb in VERBS.items())
    return f"usage: softwarp VERB ...   (softwarp VERB --help tells more)\n\n{verbs}"


def _fail(message: str, *, code: int = BAD_INPUT) -> int:
    try:
        sys.stderr.write(f"softwarp {message}\n")
        sys.stderr.flush()
    except OSError:  # nobody can be told; the code still says it
        _silence(sys.stderr)
    return code


def _silence(stream: TextIO) -> None:
    """Let go what is yet to be written to a stream that takes nothing more."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _own_place(error: Exception) -> str:
    """Where code of the user's own, such as a task, raised it or led to it; empty where there is none."""
    ours = [str(ROOT), *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))]
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if Path(frame.filename).is_file() and not _lies_in(frame.filename, ours)]
    return f" ({own[-1].filename}, line {own[-1].lineno}, in {own[-1].name})" if own else ""


def _lies_in(file: str, folders: Sequence[str]) -> bool:
    places = {Path(file).absolute(), Path(file).resolve()}
    return any(place.is_relative_to(folder) for folder in folders for place in places)


def _reason(error: Exception) -> str:
    """What an exception says, for a reader; error numbers of the system are left out."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror if error.filename is None else f"{error.filename}: {error.strerror}"
    return str(error)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    with contextlib.suppress(OSError):  # a full disk below a redirection
        sys.stderr.write(f"warning: {message}\n")
