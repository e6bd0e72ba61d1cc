"""25 tangled squares under four strategies [Volino 2006, Fig. 6]."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import clothgym as cg
from clothgym.benchmarks.report import Table
from clothgym_envs.tour.section import Section, fidelity, watch

STRATEGIES = ("none", "local", "global", "hybrid")
STEPS, SHOWN = 25, (0, 5, 12, 25)
COLUMNS = (
    "strategy", "hits at start", "contours at start", "L/L0 at step 10", "first clean step", f"hits at step {STEPS}",
    "max strain", "ms a step",
)  # fmt: skip
TITLE = "25 tangled squares"


def camera() -> Any:
    """Of all pictures of the squares."""
    from clothgym.recording.frames import Camera

    return Camera((2.0, 1.6, 2.8), (0.0, 0.62, 0.0))


def first_picture(out: Path) -> Path:
    """The tangled squares before anything moves."""
    from clothgym.recording import frames, pictures

    simulation = cg.Simulation(cg.scenes.make("squares"), fidelity("none"))
    path = out / "squares_start.png"
    frames.save_png(path, pictures.draw(simulation, camera(), 640, 480, antialias=2))
    return path


def run(out: Path, strategy: str) -> Section:
    """The squares under one strategy; `joined` makes one section of all."""
    simulation = cg.Simulation(cg.scenes.make("squares"), fidelity(strategy))
    result = watch(simulation, STEPS, SHOWN, camera(), out / f"squares_{strategy}.rrd")
    h = result["history"]
    length = h["contour_length"]
    row = (
        strategy, int(h["hits"][0]), int(h["contour_count"][0]), length[10] / length[0], result["first_clean_step"],
        int(h["hits"][-1]), max(h["max_strain"]), result["ms_per_step"],
    )  # fmt: skip
    pictures = [(image, f"{strategy} {caption}") for image, caption in result.pop("pictures")]
    sheets = [(f"squares_{strategy}.png", f"strategy {strategy}", pictures)]
    return Section(TITLE, "", {"strategy": strategy} | result, [Table("", COLUMNS, [row])], sheets, h)


def joined(sections: list[Section]) -> Section:
    """All strategies in one table."""
    text = (
        "25 squares of 288 triangles are thrown into each other and fall. Blue lines are intersection contours. Without "
        "untangling they fall as a clump; look how the global and hybrid schemes clear them in the air."
    )
    rows = [s.tables[0].rows[0] for s in sections]
    table = Table("25 squares [Volino 2006, Fig. 6]", COLUMNS, rows)
    document = {"strategies": [s.document for s in sections]}
    return Section(TITLE, text, document, [table], [sheet for s in sections for sheet in s.sheets])


def plot(out: Path, sections: list[Section]) -> Path | None:
    """Contour length and strain over the steps; None where matplotlib is not installed."""
    try:
        from clothgym.benchmarks.machine import pyplot

        plt = pyplot()
    except cg.MissingExtraError:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4))
    for s in sections:
        length = s.history["contour_length"]
        axes[0].plot([value / length[0] for value in length], label=s.document["strategy"])
        axes[1].plot(s.history["max_strain"], label=s.document["strategy"])
    axes[0].set(xlabel="step (0.01 s)", ylabel="contour length L / L0", ylim=(0, None))
    axes[1].set(xlabel="step (0.01 s)", ylabel="largest strain", ylim=(0, None))
    axes[0].legend()
    figure.tight_layout()
    path = out / "squares.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
