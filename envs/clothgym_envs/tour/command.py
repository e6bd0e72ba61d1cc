"""The command `clothgym demo`: runs the sections, leaves recordings, pictures and one HTML page."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from clothgym.benchmarks.report import Page
from clothgym.commands import JsonOption, answer, progress_bar, reserved_stdout, say
from clothgym_envs.tour import episodes, garments, shells, squares
from clothgym_envs.tour.section import Section

_HELP = """The tour: skirt and shirt sewn onto a body, 25 tangled squares under four strategies, two shells on a torso pushed
through each other, one scripted episode of each task, recorded and replayed.

Leaves recordings (.rrd), pictures and one page, index.html, in logs/demo.
"""


def register(app: typer.Typer) -> None:
    """Adds `demo`."""
    app.command("demo", help=_HELP)(demo)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for everything the tour leaves.")] = Path("logs/demo"),
    jobs: Annotated[int, typer.Option(min=1, max=64, help="Processes that the sections are shared by.")] = 2,
    as_json: JsonOption = False,
) -> None:
    started = time.perf_counter()
    with reserved_stdout(as_json):
        out.mkdir(parents=True, exist_ok=True)
        first = squares.first_picture(out)
        say(f"first picture after {time.perf_counter() - started:.1f} s: {first}")
        sections, plot = _run(out, jobs)
        page = _page(out, sections, plot)
        seconds = time.perf_counter() - started
    document: dict[str, Any] = {"page": str(page), "seconds": seconds}
    document |= {section.title: section.document for section in sections}
    answer(document, [table for section in sections for table in section.tables], as_json)
    say(f"done in {seconds:.1f} s; open {page}")
    for name in sorted(p.name for p in out.glob("*.rrd")):
        say(f"  clothgym replay {out / name} --view")


def _run(out: Path, jobs: int) -> tuple[list[Section], Path | None]:
    """All sections, in the order of the page, and the plot of the squares."""
    from joblib import Parallel, delayed

    # the longest first, so that the processes end together
    work: list[tuple[str, Callable[..., Section], tuple[Any, ...]]] = [
        *(("squares", squares.run, (out, strategy)) for strategy in squares.STRATEGIES),
        *(("garments", garments.run, (out, pattern)) for pattern in garments.PATTERNS),
        ("shells", shells.run, (out,)),
        *(("episodes", episodes.run, (out, env_id)) for env_id in episodes.EPISODES),
    ]
    found: dict[str, list[Section]] = {}
    with progress_bar("demo", len(work)) as advance:
        parallel = Parallel(n_jobs=jobs, return_as="generator")
        results = parallel(delayed(run)(*args) for _, run, args in work)
        for number, ((kind, _, _), section) in enumerate(zip(work, results), 1):
            found.setdefault(kind, []).append(section)
            advance(number, kind)
    sections = [
        garments.joined(found["garments"]),
        squares.joined(found["squares"]),
        *found["shells"],
        *found["episodes"],
    ]
    return sections, squares.plot(out, found["squares"])


def _page(out: Path, sections: list[Section], plot: Path | None) -> Path:
    from clothgym.recording.frames import save_png, tile

    page = Page("clothgym demo")
    for section in sections:
        page.add_heading(section.title).add_text(section.text)
        for table in section.tables:
            page.add_table(table)
        if plot is not None and section.title == squares.TITLE:
            page.add_image(plot, "Contour length and strain over the steps, per strategy")
        for name, caption, pictures in section.sheets:
            images, captions = zip(*pictures)
            save_png(out / name, tile(images, captions, 4))
            page.add_image(out / name, caption)
    recordings = sorted(p.name for p in out.glob("*.rrd"))
    page.add_text(
        "Recordings to open with clothgym replay FILE --view: " + ", ".join(recordings)
        if recordings
        else 'No recordings: install rerun with pip install "clothgym[rerun]".'
    )
    return page.write(out / "index.html")
