"""Curves, maps and pictures of the untangling benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import clothgym as cg
from clothgym.benchmarks.frame import Row
from clothgym.benchmarks.machine import pyplot
from clothgym.benchmarks.untangling import faults, instances, squares
from clothgym.benchmarks.untangling.measure import of_part, quantile
from clothgym.recording.frames import Camera, Image, save_png, tile
from clothgym.recording.pictures import draw
from clothgym.scenes.canonical import KINDS
from clothgym.scenes.hard import DRAWN

_WIDTH, _HEIGHT = 300, 280
_SHOWN: tuple[tuple[str, dict[str, Any]], ...] = (
    ("figure_two", {"row": "middle"}),
    ("garment_layers", {"layers": 3}),
    ("folds", {}),
    ("waist", {}),
    ("strip_through_sheet", {}),
    ("crumple", {}),
)
"""Tangles that are not canonical, drawn before and after."""


def plots(rows: list[Row], folder: Path) -> list[Path]:
    """What the parts of the rows can be shown by."""
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    for part, make, name in (
        ("canonical", _depth_curves, "untangling_depth.png"),
        ("map", _maps, "untangling_map.png"),
        ("faults", _fault_curves, "untangling_faults.png"),
    ):
        if own := of_part(rows, part):
            found.append(make(own, folder / name))
    for part, show, name in (
        ("canonical", _kinds, "untangling_kinds.png"),
        ("others", _hard, "untangling_tangles.png"),
        ("faults", _fault_pictures, "untangling_faulty_detection.png"),
        ("dish", _dish_pictures, "untangling_ribbon.png"),
    ):
        if of_part(rows, part):
            found.append(save_png(folder / name, show()))
    return found


def _depth_curves(rows: list[Row], path: Path) -> Path:
    """Share correctly resolved, and median passes, over the depth: a column a kind, a line a strategy."""
    plt = pyplot()
    compared = list(dict.fromkeys(row["parameters"]["strategy"] for row in rows))
    colours = squares.strategy_colours(compared)
    figure, axes = plt.subplots(2, len(KINDS), figsize=(3.0 * len(KINDS), 5.5), sharex=True, constrained_layout=True)
    for column, kind in enumerate(KINDS):
        for strategy in compared:
            own = [
                row for row in rows
                if row["parameters"]["strategy"] == strategy and row["parameters"]["settings"]["kind"] == kind
            ]  # fmt: skip
            own.sort(key=lambda row: row["parameters"]["settings"]["depth"])
            depths = [row["parameters"]["settings"]["depth"] for row in own]
            right = [100.0 * float(np.mean(row["result"]["right"])) for row in own]
            passes = [quantile(row["result"]["passes"], 0.5) or np.nan for row in own]
            axes[0, column].plot(depths, right, ".-", color=colours[strategy], label=strategy)
            axes[1, column].plot(depths, passes, ".-", color=colours[strategy])
        axes[0, column].set_title(kind)
        axes[0, column].set_ylim(-4.0, 104.0)
        axes[1, column].set_ylim(0.0, 60.0)
        axes[1, column].set_xlabel("depth [edges]")
    axes[0, 0].set_ylabel("correctly resolved [%]")
    axes[1, 0].set_ylabel("passes, median")
    axes[0, -1].legend(fontsize=7)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _maps(rows: list[Row], path: Path) -> Path:
    """Median passes over h0 and velocity share; crosses where not all instances were correctly resolved."""
    plt = pyplot()
    places = list(dict.fromkeys((row["parameters"]["settings"]["kind"], row["parameters"]["strategy"]) for row in rows))
    figure, axes = plt.subplots(
        1, len(places), figsize=(4.2 * len(places), 3.8), squeeze=False, constrained_layout=True
    )
    for axis, (kind, strategy) in zip(axes[0], places):
        own = [
            row for row in rows
            if (row["parameters"]["settings"]["kind"], row["parameters"]["strategy"]) == (kind, strategy)
        ]  # fmt: skip
        sizes = sorted({row["parameters"]["fields"]["h0"] for row in own})
        shares = sorted({row["parameters"]["fields"]["velocity_share"] for row in own})
        passes = np.full((len(shares), len(sizes)), np.nan)
        for row in own:
            fields = row["parameters"]["fields"]
            at = shares.index(fields["velocity_share"]), sizes.index(fields["h0"])
            passes[at] = quantile(row["result"]["passes"], 0.5) or np.nan
            share = float(np.mean(row["result"]["right"]))
            text = "-" if np.isnan(passes[at]) else f"{passes[at]:.0f}"
            text += "" if share == 1.0 else f"\n{100.0 * share:.0f} %"
            axis.text(at[1], at[0], text, ha="center", va="center", fontsize=8)
        axis.imshow(passes, origin="lower", cmap="viridis_r", vmin=0.0, vmax=40.0, alpha=0.7, aspect="auto")
        axis.set_xticks(range(len(sizes)), [f"{size:g}" for size in sizes])
        axis.set_yticks(range(len(shares)), [f"{share:g}" for share in shares])
        axis.set_xlabel("h0 [edges]")
        axis.set_ylabel("velocity share")
        axis.set_title(f"{kind}, {strategy}: passes (and % correct below 100)", fontsize=9)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def _fault_curves(rows: list[Row], path: Path) -> Path:
    """True contour length over the steps."""
    plt = pyplot()
    compared = list(dict.fromkeys(row["parameters"]["strategy"] for row in rows))
    colours = squares.strategy_colours(compared)
    figure, axes = plt.subplots(figsize=(7.0, 4.0), constrained_layout=True)
    axes.set_yscale("symlog", linthresh=1.0)
    for row in rows:
        strategy = row["parameters"]["strategy"]
        label = strategy if row["parameters"]["seed"] == 0 else None
        axes.plot(row["result"]["history"]["length"], color=colours[strategy], label=label, lw=1.0)
    axes.set_xlabel("step of 1/100 s")
    axes.set_ylabel("true contour length [edges]")
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)
    plt.close(figure)
    return path


def _before_and_after(name: str, settings: dict[str, Any], strategy: str, steps: int = 60) -> list[Image]:
    """The start of a tangle, and where a strategy leaves it."""
    drawn = DRAWN[name](**settings, seed=0)
    simulation = cg.Simulation(drawn.scene, cg.Fidelity(**(instances.FIELDS | {"untangling": strategy})))
    images = [draw(simulation, width=_WIDTH, height=_HEIGHT, antialias=2)]
    for _ in range(steps):
        simulation.step()
        if simulation.last_intersections.hit_count == 0:
            break
    return [*images, draw(simulation, width=_WIDTH, height=_HEIGHT, antialias=2)]


def _pairs(shown: Sequence[tuple[str, dict[str, Any], str]]) -> Image:
    images, labels = [], []
    for name, settings, strategy in shown:
        images += _before_and_after(name, settings, strategy)
        title = " ".join([name, *(str(v) for k, v in settings.items() if k != "resolution")])
        labels += [title, f"after {strategy}"]
    return tile(images, labels, columns=6)


def _kinds() -> Image:
    return _pairs([("canonical", {"kind": kind, "depth": 3.0, "resolution": 16}, "hybrid") for kind in KINDS])


def _hard() -> Image:
    return _pairs([(name, settings, "hybrid") for name, settings in _SHOWN])


def _fault_pictures() -> Image:
    """Cloth while half of the detection fails, without and with untangling, as the paper's Fig. 7 has it."""
    images, labels = [], []
    for strategy in ("none", "local"):
        fidelity = cg.Fidelity(**(faults.FIELDS | {"untangling": strategy}))
        simulation = cg.Simulation(cg.scenes.make("faulty_detection"), fidelity)
        for step in range(1, 61):
            simulation.step()
            if step in (20, 30, 45, 60):
                images.append(draw(simulation, width=360, height=280, antialias=2))
                labels.append(f"{strategy}, step {step}: {simulation.last_intersections.hit_count} hits")
    return tile(images, labels, columns=4)


def _dish_pictures() -> Image:
    """A short ribbon in its dish."""
    simulation = cg.Simulation(cg.scenes.make("ribbon", length=6.0), cg.Fidelity(untangling="local", substeps=1))
    rim = simulation.positions[simulation.cloth_ranges[1][1]]
    camera = Camera.framing(np.concatenate([rim, rim + np.array([0.0, 0.1, 0.0])]), direction=(0.5, 0.7, 1.0))
    images, labels = [], []
    for step in range(1, 181):
        simulation.step()
        if step % 60 == 0:
            images.append(draw(simulation, camera, 360, 320, antialias=2))
            labels.append(f"{simulation.time:.2f} s: {simulation.last_intersections.hit_count} hits")
    return tile(images, labels, columns=3)
