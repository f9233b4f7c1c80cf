"""The page ``docs/accuracy.md`` and its pictures, from the records of ``softwarp bench accuracy``."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from softwarp.io.atomic import atomic_path, write_text

from .solids import Problem

Record = dict[str, Any]
BOUND = 0.02
STYLE = {"p1": ("o-", "#c44e52"), "p2": ("s-", "#4c72b0")}
NAMES = {"p1": "linear (`p1`)", "p2": "quadratic (`p2`)"}
PANELS = (
    ("unknowns", "unknowns", 1.0),
    ("static_s", "static solve [s]", 1.0),
    ("ms_per_step", "step of 10 ms [ms]", 1.0),
)


def write(problems: list[Problem], records: list[Record], docs: Path) -> None:
    """Draw every problem that has records and write the page."""
    parts = [_head(records)]
    for problem in problems:
        rows = [record for record in records if record["problem"] == problem.name]
        if rows:
            draw(problem, rows, docs / "images" / f"accuracy_{problem.name}.png")
            parts.append(section(problem, rows))
    parts += [_orders(records), _CHOICE, _locking(Path(__file__).parent / "results" / "accuracy" / "locking.json")]
    write_text(docs / "accuracy.md", "\n\n".join(part for part in parts if part).rstrip() + "\n")


def draw(problem: Problem, rows: list[Record], path: Path) -> None:
    """Error against unknowns, time of a static solve and time of a step, a line per element."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(9.6, 3.0), layout="constrained", sharey=True)
    for axis, (key, label, factor) in zip(axes, PANELS, strict=True):
        for element, (marker, colour) in STYLE.items():
            line = sorted(
                (factor * row[key], 100.0 * abs(row["error"]))
                for row in rows
                if row["element"] == element and row.get("graded", True)
            )
            axis.plot(*zip(*line, strict=True), marker, color=colour, label=element, markersize=4.5)
        axis.axhline(100.0 * BOUND, color="0.5", linewidth=0.8, linestyle="--")
        axis.set(xscale="log", yscale="log", xlabel=label)
        axis.grid(True, which="both", alpha=0.25)
        for scale in (axis.xaxis, axis.yaxis):
            scale.set_major_formatter("{x:g}")
            scale.set_minor_formatter("")
    axes[0].set_ylabel("error [%]")
    axes[0].legend()
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=90)
    pyplot.close(figure)


def section(problem: Problem, rows: list[Record]) -> str:
    """Picture, table and what it says."""
    quantity = problem.quantity[0].upper() + problem.quantity[1:]
    lines = [
        f"## {problem.title}",
        "",
        f"{quantity} [{problem.unit}], right: **{problem.exact:.5g}** ({problem.source}).",
        "",
        f"![error against unknowns and times](images/accuracy_{problem.name}.png)",
        "",
        "| element | cells | unknowns | answer | error | static solve [s] | step [ms] |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = ", ".join(map(str, row["cells"] if problem.name[:6] != "sphere" else row["cells"][:2]))
        uniform = "" if row.get("graded", True) else " uniform"
        lines.append(
            f"| {NAMES[row['element']]} | ({cells}){uniform} | {row['unknowns']} | {row['value']:.5g} | "
            f"{100.0 * row['error']:+.1f} % | {_figure(row['static_s'])} | {_figure(row['ms_per_step'])} |"
        )
    return "\n".join([*lines, "", statement(rows)])


def statement(rows: list[Record]) -> str:
    """Which mesh of each element reaches the bound, with what unknowns and times."""
    good = {e: [r for r in rows if r["element"] == e and abs(r["error"]) <= BOUND] for e in STYLE}
    if not good["p2"]:
        best = min((r for r in rows if r["element"] == "p2"), key=lambda r: abs(r["error"]))
        return f"No quadratic mesh here reaches 2 %; the best is {100.0 * abs(best['error']):.1f} % off."
    p2 = min(good["p2"], key=lambda r: r["unknowns"])
    text = (
        f"Quadratic elements are within 2 % with {p2['unknowns']} unknowns, {_figure(p2['static_s'])} s for the static "
        f"solve and {_figure(p2['ms_per_step'])} ms for a step. "
    )
    p1 = min(good["p1"], key=lambda r: r["unknowns"], default=None)
    worst = p1 or max((r for r in rows if r["element"] == "p1"), key=lambda r: r["unknowns"])
    error = f"{100.0 * abs(worst['error']):.1f} %"
    times = f"{_figure(worst['static_s'])} s ({_figure(worst['static_s'] / p2['static_s'])} times) and "
    times += f"{_figure(worst['ms_per_step'])} ms ({_figure(worst['ms_per_step'] / p2['ms_per_step'])} times)"
    if p1:
        return text + f"Linear ones need {p1['unknowns']} unknowns for {error}, {times}."
    return text + f"Linear ones are still {error} off with {worst['unknowns']} unknowns, {times}."


def _figure(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"


def _head(records: list[Record]) -> str:
    about = next((record for record in records if "hardware" in record), None)
    machine = f"{about['hardware']}, commit `{about['commit']}`" if about else "a machine to come"
    rows = [record for record in records if record["problem"] == "cantilever"]
    uniform = [r for r in rows if not r.get("graded", True)]
    good = [r for r in rows if r["element"] == "p2" and abs(r["error"]) <= BOUND]
    if not uniform or not good:
        return _INTRODUCTION.format(machine=machine)
    linear, p2 = uniform[0], min(good, key=lambda r: r["unknowns"])
    text = _INTRODUCTION.format(machine=machine) + _SHORT.format(
        linear=linear["value"],
        linear_unknowns=linear["unknowns"],
        linear_error=-100.0 * linear["error"],
        p2=p2["value"],
        p2_unknowns=p2["unknowns"],
        p2_error=100.0 * abs(p2["error"]),
        static=p2["static_s"] / linear["static_s"],
        step=p2["ms_per_step"] / linear["ms_per_step"],
    )
    near = [r for r in rows if r["element"] == "p1" and abs(r["error"]) <= BOUND]
    if not near:
        return text
    fine = min(near, key=lambda r: r["unknowns"])
    return text + _FINE.format(
        unknowns=fine["unknowns"],
        share=fine["unknowns"] / p2["unknowns"],
        static=_figure(fine["static_s"] / p2["static_s"]),
        step=_figure(fine["ms_per_step"] / p2["ms_per_step"]),
    )


_INTRODUCTION = """\
<!-- made by `softwarp bench accuracy`; edit benchmarks/accuracy_page.py -->

# Accuracy

How far the elements are from the right answer, and what an answer costs: error against unknowns and against time.
Whether the code solves the equations of its mesh is another question, which [validation.md](validation.md) answers.

`softwarp bench accuracy` measures and writes this page. One world, one core; the static solve in float64 from rest to a
relative imbalance of 1e-7, the step of 10 ms in float32 with one linearisation. Times are medians of processor time on
{machine}. The machine is shared, and others in its caches change
them by tens of per cent: read factors, not digits. Both elements get the same kind of mesh; the dashed line is 2 %."""

_SHORT = """

**In short.** The silicone cantilever that simulators are compared on sags {linear:.1f} mm with {linear_unknowns}
unknowns of linear elements, {linear_error:.0f} % too little. Quadratic elements with {p2_unknowns} unknowns give
{p2:.1f} mm, {p2_error:.1f} % off: fewer unknowns than that linear mesh, {static:.2g} times its time for a static solve
and {step:.2g} times for a step."""

_FINE = """ Linear elements come within 2 % with {unknowns} unknowns, {share:.0f} times as many
as those quadratic ones; a static solve takes {static} times as long, a step {step} times."""


def _orders(records: list[Record]) -> str:
    space = [record for record in records if record["problem"] == "orders_space"]
    time = [record for record in records if record["problem"] == "orders_time"]
    lines = ["## Orders of convergence", ""]
    if space:
        lines += [
            "**In space.** Manufactured neo-Hookean solution on the unit cube (`tests/physics/test_convergence.py`),",
            "errors in L2 of displacement and gradient. In theory the orders are 2 and 1 for linear, 3 and 2 for",
            "quadratic elements.",
            "",
            "| element | cells per edge | displacement | order | gradient | order |",
            "|---|---|---|---|---|---|",
        ]
        for element in STYLE:
            rows = [record for record in space if record["element"] == element]
            for before, row in zip([None, *rows], rows, strict=False):
                orders = ["", ""]
                if before:
                    ratio = math.log(row["cells"] / before["cells"])
                    pairs = zip(before["errors"], row["errors"], strict=True)
                    orders = [f"{math.log(a / b) / ratio:.2f}" for a, b in pairs]
                lines.append(
                    f"| {NAMES[element]} | {row['cells']} | {row['errors'][0]:.2e} | {orders[0]} | "
                    f"{row['errors'][1]:.2e} | {orders[1]} |"
                )
        lines.append("")
    if time:
        lines += [
            "**In time.** Backward Euler, the default: the cantilever 0.08 s after it was let",
            f"go, largest error of a position against steps of {1e3 * time[0]['fine']:g} ms. It tends to order 1",
            "whether the equations of a step are linearised once or solved. A long step costs damping, not stability.",
            "",
            "| step [ms] | one linear solve [mm] | order | Newton converged [mm] | order |",
            "|---|---|---|---|---|",
        ]
        by = {n: [record for record in time if record["iterations"] == n] for n in (1, 8)}
        for i, row in enumerate(by[1]):
            cells = [f"{1e3 * row['dt']:.3g}"]
            for n in (1, 8):
                order = _time_order(by[n][i - 1], by[n][i]) if i else ""
                cells += [f"{1e3 * by[n][i]['error']:.3g}", order]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _time_order(before: Record, after: Record) -> str:
    """Order of e = c dt^p when the reference has the error of its own step."""
    steps = (before["dt"] - before["fine"]) / (after["dt"] - after["fine"])
    return f"{math.log(before['error'] / after['error']) / math.log(steps):.2f}"


_CHOICE = """\
## Which element

`builder.add_tets(mesh, material=..., density=..., element="p2")`; the default is `p1`.

- **Comparison with SOFA** or another simulator with linear tetrahedra, or a task that was defined by one: `p1` on the
  same mesh. The environments [Trunk](environments/trunk.md), [Diamond](environments/diamond.md) and
  [CatchTheObject](environments/catch_the_object.md) do, and tell what it costs in truth.
- **Truth** (a robot to be built, a modulus that was measured): `p2` on a coarse mesh, fine where it bends most. One or
  two cells through the thickness are enough in bending, where linear elements need ten. Keep the linear mesh's cells
  and there are eight times as many nodes, for digits that the modulus does not have.
- **Near incompressibility** linear elements lose nearly everything, quadratic ones some per cent on coarse cells."""


def _locking(path: Path) -> str:
    """Table and verdict of the study of linear elements."""
    if not path.is_file():
        return ""
    rows = json.loads(path.read_text(encoding="utf-8"))
    columns = list(dict.fromkeys((row["study"], row["mesh"]) for row in rows))
    columns = [column for column in columns if column not in _LEFT_OUT]
    by = {(row["study"], row["mesh"], row["element"]): row for row in rows}
    elements = list(dict.fromkeys(row["element"] for row in rows))
    head = " | ".join(f"{study}, {mesh}" for study, mesh in columns)
    lines = [f"| shear, dilatation over | {head} |", "|---|" + "---|" * len(columns)]
    for element in elements:
        cells = [f"{100.0 * by[(*column, element)]['error']:+.1f}" for column in columns]
        lines.append(f"| {_LOCKING_NAMES[element]} | " + " | ".join(cells) + " |")
    lines += ["", "Million operations of a factorisation, and to assemble the tangent; blocks of L in thousands:", ""]
    lines += [f"| shear, dilatation over | {head} |", "|---|" + "---|" * len(columns)]
    for element in [name for name in elements if name != "mini"]:
        costs = [by[(*column, element)] for column in columns]
        cells = [f"{c['factor_mflop']:.3g} + {c['assembly_mflop']:.3g}; {c['blocks'] / 1e3:.3g}" for c in costs]
        lines.append(f"| {_LOCKING_NAMES[element]} | " + " | ".join(cells) + " |")
    return "\n".join([_LOCKING_HEAD, *lines, "", _LOCKING_VERDICT])


_LEFT_OUT = (("cantilever, nu 0", "(10, 2, 2)"), ("cantilever, nu 0.499", "(10, 2, 2)"), ("Cook, nu 0.3", "(4, 4, 1)"))
_LOCKING_NAMES = {
    "p1": "tetrahedron, tetrahedron (`p1`)",
    "average": "tetrahedron, node (average nodal pressure)",
    "patch": "tetrahedron, patch of 8 (F-bar patch)",
    "mini": "P1 with a bubble and nodal pressures (MINI)",
    "face": "face, face",
    "edge": "edge, edge",
    "node": "node, node",
    "edge, node": "edge, node",
    "edge, patch": "edge, patch of 8",
    "edge, patch of 4": "edge, patch of 4",
    "edge, patch of 12": "edge, patch of 12",
    "p2": "ten nodes (`p2`), same cells",
}

_LOCKING_HEAD = """\
## Linear elements that lock less

Is there a cheaper cure than ten nodes? `softwarp bench locking` compares linear tetrahedra whose strain is averaged
over *domains* of several, the part with $\\mu$ (shear) over one kind, the part with $\\lambda$ (dilatation) over
another. Small strain, NumPy, float64; errors in per cent against quadratic elements on finer cells. Domains couple
more nodes, and a direct factorisation pays for that.
"""

_LOCKING_VERDICT = """\
What the columns say:

- **Most of it is shear.** With $\\nu = 0$ there is no volumetric locking, and linear elements are as far off as
  with 0.45. Average nodal pressure, F-bar patches and MINI leave that part as it is: at $\\nu = 0.45$ they win
  2 to 6 of the 22 %. Averaging shear over the tetrahedra around an edge takes five sixths of it away.
- Domains around **nodes** are too soft instead of too stiff, on the trunk by more than the answer itself, and
  cost three to fifteen times as much to factorise.
- **Edges for shear with patches for dilatation** are the only pair that cures both: on two cells through the
  thickness 4 % off at $\\nu = 0.45$ and 1 % at 0.499 (17 % at 0, where there is no dilatation to average). L is
  1.9 to 3.3 times as large as that of `p1` on the same cells, a factorisation 3 to 9 times as dear.
- Next to **quadratic elements on coarser cells** this is no clear gain at $\\nu \\le 0.45$: for 3 % on Cook's
  membrane with $\\nu = 0.3$ they need 15 million operations and `p2` on half the cells 6; for 30 % on the trunk
  they need 19 and `p2` 50. It is a clear one near incompressibility: at $\\nu = 0.499$ they are nearer on
  Cook's membrane than `p2` on the same cells for a fifteenth of the operations.
- The answer depends on **how patches are cut**: from 4 to 12 tetrahedra the error on the coarse trunk runs from
  $-61$ to $-19$ %, and on Cook's membrane with $\\nu = 0.499$ its sign changes. `p2` approaches all answers of
  this table from one side.

**Decision: not beside `p2` for now.** The bodies here have $\\nu \\le 0.45$. There quadratic elements on a
coarse mesh give the same for about the same cost, with a known order, without a choice of patches, and with
every law and SOFA's rotation. For nearly incompressible bodies on meshes that cannot be coarser the element to
add is edges with patches."""
