"""Tables of the trade-off."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.report import Table
from clothgym.benchmarks.tradeoff import strain
from clothgym.benchmarks.tradeoff.front import Point, beaten_by, clamped, front
from clothgym.benchmarks.tradeoff.subjects import SUBJECTS, Error

_WORK = (
    "box_tests",
    "primitive_pairs",
    "contacts",
    "hits",
    "zoned",
    "solver_steps",
    "linear_iterations",
    "unconverged",
)
"""Counters of a frame that are shown; the rows have all."""


def of_kind(rows: Sequence[Row], kind: str, subject: str | None = None) -> list[Row]:
    """Rows of a kind, and of a subject."""
    return [
        row for row in rows if row["parameters"]["kind"] == kind and subject in (None, row["parameters"].get("subject"))
    ]


def subjects_in(rows: Sequence[Row]) -> list[str]:
    """Names of the subjects that rows have, in the order of `SUBJECTS`."""
    return [name for name in SUBJECTS if of_kind(rows, "run", name)]


def points(rows: Sequence[Row], subject: str) -> list[Point]:
    """Those settings of a subject that ran to their end."""
    errors = SUBJECTS[subject].errors
    found = []
    for row in of_kind(rows, "run", subject):
        result = row["result"]
        if result["refused"] or result["ms_per_second"] is None:
            continue
        values = tuple(error.factor * result[error.name] for error in errors)
        found.append(Point(row["parameters"]["label"], result["ms_per_second"], values))
    return found


def floors(rows: Sequence[Row], subject: str) -> list[float]:
    """How far two runs at high effort are apart in every error of a subject; 0 where there is no reference."""
    for row in of_kind(rows, "reference", subject):
        p = row["parameters"]
        if (p["membrane"], p["bending"]) == ("springs", "flexion"):
            check = row["result"]["check"] or {}
            return [error.factor * (check.get(error.name) or 0.0) for error in SUBJECTS[subject].errors]
    return [0.0] * len(SUBJECTS[subject].errors)


def tables(rows: list[Row]) -> list[Table]:
    """Presets, fronts, references, Runge-Kutta, strain limiting, then every run."""
    found = []
    names = subjects_in(rows)
    if names:
        found += [_preset_table(rows, names), *(_front_table(rows, name) for name in names)]
    if of_kind(rows, "reference"):
        found.append(_reference_table(of_kind(rows, "reference")))
    explicit = _explicit_table(rows, names)
    if explicit.rows:
        found.append(explicit)
    if of_kind(rows, "strain"):
        found += [_strain_table(of_kind(rows, "strain"))]
    return found + [_run_table(rows, name) for name in names]


def _titled(error: Error) -> str:
    return f"{error.text} [{error.unit}]"


def _preset_table(rows: Sequence[Row], names: Sequence[str]) -> Table:
    """What each preset and target costs and misses, and what beats it."""
    cells: list[tuple[Any, ...]] = []
    for name in names:
        own, limits = points(rows, name), floors(rows, name)
        for row in of_kind(rows, "run", name):
            p, result = row["parameters"], row["result"]
            if p["group"] not in ("preset", "target"):
                continue
            point = next((point for point in own if point.label == p["label"]), None)
            if point is None:
                cells.append((name, p["label"], None, result["why"] or result["refused"], "no", None, None))
                continue
            better = beaten_by(point, own, limits)
            missed = ", ".join(
                f"{error.name} {value:.3g} {error.unit}" for error, value in zip(SUBJECTS[name].errors, point.errors)
            )
            cells.append(
                (
                    name, point.label, point.cost, missed, "no" if better else "yes",
                    better.label if better else None, point.cost / better.cost if better else None,
                )
            )  # fmt: skip
    columns = (
        "scene",
        "setting",
        "ms per simulated second",
        "errors",
        "on the front",
        "beaten by",
        "which is cheaper x",
    )
    note = (
        "On the front: no setting is a tenth cheaper and no worse in any of the scene's errors (errors within a twentieth, or "
        "below what the reference can tell, count as equal)."
    )
    return Table("Presets and targets", columns, cells, note)


def _front_table(rows: Sequence[Row], name: str) -> Table:
    own, errors = points(rows, name), SUBJECTS[name].errors
    fronts: dict[str, list[str]] = {}
    for number, error in enumerate(errors):
        for point in front(clamped(own, floors(rows, name)), number):
            fronts.setdefault(point.label, []).append(error.name)
    cells = [
        (point.label, point.cost, *point.errors, ", ".join(fronts[point.label]))
        for point in sorted(own, key=lambda point: point.cost)
        if point.label in fronts
    ]
    columns = ("setting", "ms per simulated second", *(_titled(error) for error in errors), "on the front of")
    return Table(f"Front: {name}", columns, cells, SUBJECTS[name].text)


def _reference_table(rows: Sequence[Row]) -> Table:
    cells = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        check = r["check"] or {}
        cells.append(
            (
                p["subject"], p["membrane"], p["bending"], r["ms_per_second"], 100 * r["stretch"], 100 * r["stretch_p99"],
                *(None if check.get(key) is None else scale * check[key] for key, scale in (
                    ("stretch_error", 100), ("rms_distance", 1e3), ("max_distance", 1e3), ("height_error", 1e3))),
            )
        )  # fmt: skip
    columns = (
        "scene", "membrane", "bending", "ms per simulated second", "peak stretch [%]", "p99 [%]", "uncertain: stretch [%]",
        "rms distance [mm]", "largest distance [mm]", "height [mm]",
    )  # fmt: skip
    note = (
        "Converged runs: Runge-Kutta for hanging sheets, XPBD at high effort with contact. Uncertain: distance to another run "
        "at high effort (XPBD of 24 substeps a cell; fewer substeps), which cannot be told from an error. Positions and "
        "heights until the horizon: "
        + ", ".join(f"{name} {it.horizon:g} s" for name, it in SUBJECTS.items() if it.reference)
        + "."
    )
    return Table("References", columns, cells, note)


def _explicit_table(rows: Sequence[Row], names: Sequence[str]) -> Table:
    """Runge-Kutta beside symplectic Euler, each at its own largest steps and finer."""
    cells = []
    for name in names:
        runs = {row["parameters"]["label"]: row["result"] for row in of_kind(rows, "run", name)}
        euler = runs.get("symplectic_euler")
        if euler is None or "runge_kutta" not in runs or not euler["ms_per_second"]:
            continue
        base = euler["ms_per_second"] / euler["substeps"]
        for label, r in runs.items():
            if label.startswith(("symplectic_euler", "runge_kutta")) and r["ms_per_second"]:
                cells.append(
                    (
                        name, label, r["substeps"], r["ms_per_second"], r["ms_per_second"] / euler["ms_per_second"],
                        r["ms_per_second"] / r["substeps"] / base, 1e3 * r["rms_distance"], 100 * r["stretch_error"],
                    )
                )  # fmt: skip
    columns = (
        "scene", "integrator", "substeps a frame", "ms per simulated second", "of Euler's", "a substep, of Euler's",
        "rms distance [mm]", "error of the peak stretch [%]",
    )  # fmt: skip
    note = '[Vassilev 2001, section 3] of Runge-Kutta: "This however reduces the speed significantly".'
    return Table("Runge-Kutta beside symplectic Euler", columns, cells, note)


def _strain_table(rows: Sequence[Row]) -> Table:
    cells = []
    for row in rows:
        r = row["result"]
        for kind, substeps in (("own", r["substeps"]), ("finer", 4 * r["substeps"])):
            run = r[kind]
            step = 1e3 / 60.0 / substeps
            blew = run["blew_up_at"]
            cells.append(
                (
                    row["parameters"]["place"], row["parameters"]["arm"], step,
                    *(None if blew is not None else 100 * run[key] for key in ("end", "peak", "over", "drop")),
                    None if blew is not None else run["ms_per_second"], blew,
                    1e3 * r["largest_step"] if r["largest_step"] and kind == "own" else None,
                    1e3 * r["predicted_step"] if r["predicted_step"] and kind == "own" else None,
                )
            )  # fmt: skip
    columns = (
        "held by", "arm", "step [ms]", "stretch at the end [%]", "peak [%]", "springs over the limit [%]", "drop [cm]",
        "ms per simulated second", "blew up at [s]", "largest step that holds [ms]", "Gershgorin's bound [ms]",
    )  # fmt: skip
    note = (
        f"A sheet of 1 m, {strain.CELLS} x {strain.CELLS} cells, springs of {strain.SOFT:g} N/m, hangs {strain.SECONDS:g} s; "
        f"modifications act above {100 * strain.LIMIT:g} %. Over: longer than allowed by more than a tenth of that."
    )
    return Table("Against super-elasticity [Vassilev 2001, section 4]", columns, cells, note)


def _run_table(rows: Sequence[Row], name: str) -> Table:
    cells = []
    for row in of_kind(rows, "run", name):
        p, r = row["parameters"], row["result"]
        if r["refused"]:
            cells.append((p["group"], p["label"], *[None] * 14, r["refused"][:80]))
            continue
        shown = {key: round(value) for key, value in r["work_per_frame"].items() if key in _WORK}

        def of(key: str, factor: float, r: dict[str, Any] = r) -> float | None:
            return None if r.get(key) is None else factor * r[key]

        cells.append(
            (
                p["group"], p["label"], r["substeps"], r["sweeps"], r["ms_per_second"], r["memory_mb"],
                *(of(key, factor) for key, factor in (
                    ("stretch", 100), ("stretch_p99", 100), ("stretch_error", 100), ("rms_distance", 1e3),
                    ("max_distance", 1e3), ("height_error", 1e3), ("energy_error", 100), ("penetration", 1e3),
                    ("contour_share", 100), ("blew_up_at", 1),
                )),
                "; ".join(part for part in (r["why"][:60], ", ".join(r["flags"]), _counted(shown)) if part) or None,
            )
        )  # fmt: skip
    columns = (
        "group", "setting", "substeps", "sweeps", "ms per simulated second", "memory [MB]", "peak stretch [%]", "p99 [%]",
        "error of peak [%]", "rms distance [mm]", "largest [mm]", "height [mm]", "energy [%]", "penetration [mm]",
        "contour [%]", "blew up at [s]", "flags and work a frame",
    )  # fmt: skip
    return Table(f"Every run: {name}", columns, cells, SUBJECTS[name].text)


def _counted(work: dict[str, int]) -> str:
    return ", ".join(f"{key} {value}" for key, value in work.items() if value)
