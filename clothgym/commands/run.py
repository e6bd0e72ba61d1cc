"""`clothgym run`: simulates a scene, with a recording or pictures when asked for."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from clothgym.arrays import check_number
from clothgym.benchmarks.report import Table, json_ready
from clothgym.commands import JsonOption, Stopped, answer, ctrl_c_between_steps, progress_bar, reserved_stdout

_HELP = """Simulates a ready scene (`clothgym scenes` lists them), a scene file (.json) or your own mesh; prints its metrics.

A mesh (any format that trimesh reads, in metres, y up) falls on the ground under it, or hangs by its pins:
`clothgym run towel.obj --set material=denim --set "pins=[0, 16]" --set ground=0.0`

Exit code: 0 done, 1 the simulation diverged, 2 bad input, 130 stopped (the recording and the pictures so far are kept).
"""


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("run", help=_HELP)(run)


def run(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name of a scene, a .json file, or a mesh.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="A parameter of the scene; repeatable.")
    ] = None,
    fidelity: Annotated[
        str, typer.Option("--fidelity", metavar="F", help="draft, balanced, accurate, or a .json file.")
    ] = "balanced",
    seconds: Annotated[
        float | None, typer.Option("--seconds", help="Simulated time [s]; default: as the scene says.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the scene, where it has one.")] = 0,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="FILE.rrd", help="Writes a rerun recording.", show_default=False)
    ] = None,
    frames: Annotated[
        Path | None, typer.Option("--frames", metavar="DIR", help="Writes a PNG per frame.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    with reserved_stdout(as_json):
        document = _simulate(scene, read_settings(settings or []), fidelity, seconds, seed, record, frames)
    metrics = [(name.replace("_", " "), value) for name, value in document["metrics"].items()]
    profile = [(name, *entry) for name, entry in document["profile"].items()]
    facts = ("fidelity", "seed", "steps", "simulated", "seconds", "state_hash", "record", "frames")
    tables = [
        Table(document["scene"], ("what", "value"), [(name.replace("_", " "), document[name]) for name in facts]),
        Table("Metrics", ("quantity", "value"), metrics),
        Table("Wall time", ("stage", "calls", "seconds"), profile),
    ]
    answer(document, tables, as_json)


def _simulate(
    name: str,
    settings: dict[str, Any],
    fidelity: str,
    seconds: float | None,
    seed: int,
    record: Path | None,
    frames: Path | None,
) -> dict[str, Any]:
    import clothgym as cg

    check_number(seed, "--seed", 0, 2**63 - 1, integer=True)
    if seconds is not None:
        check_number(seconds, "--seconds", 0.0, 1e6)
    scene = _read_scene(name, settings, seed)
    simulation = cg.Simulation(scene, fidelity=read_fidelity(fidelity))
    simulation.reset()
    duration = scene.duration if seconds is None else seconds
    total = round(duration / scene.step)
    done = 0
    started = time.perf_counter()
    try:
        with (
            ctrl_c_between_steps() as may_stop,
            _recording(simulation, record) as log,
            _pictures(simulation, frames) as draw,
            progress_bar(name, total) as bar,
        ):
            log(0)
            draw(0)
            for done in range(1, total + 1):
                simulation.step()
                log(done)
                draw(done)
                bar(done, f"t = {simulation.time:.2f} s")
                may_stop()
    except KeyboardInterrupt:
        kept = [str(path) for path in (record, frames) if path is not None]
        kept_line = f"; kept what there is of {' and '.join(kept)}" if kept else ""
        raise Stopped(f"stopped at t = {simulation.time:.3f} s of {duration:g} s{kept_line}") from None
    return {
        "scene": name,
        "parameters": settings,
        "fidelity": fidelity,
        "seed": seed,
        "steps": done,
        "simulated": simulation.time,
        "seconds": time.perf_counter() - started,
        "state_hash": simulation.state_hash(),
        "metrics": as_plain(simulation.metrics()),
        "profile": as_plain(simulation.profile),
        "record": None if record is None else str(record),
        "frames": None if frames is None else str(frames),
    }


def read_settings(settings: list[str]) -> dict[str, Any]:
    """Parameters from `NAME=VALUE`; a value is JSON where it can be (numbers, true, lists), else text.

    Raises:
        ValueError: no `=`, no name, or a name given twice.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        name = name.strip()
        if not equals or not name.isidentifier():
            raise ValueError(f"--set {setting!r}: expected NAME=VALUE")
        if name in values:
            raise ValueError(f"--set {setting!r}: {name} is set twice")
        try:
            values[name] = json.loads(text)
        except ValueError:
            values[name] = text
    return values


def read_fidelity(text: str) -> Any:
    """A preset's name as it is, or the `Fidelity` of a .json file.

    Raises:
        ValueError: names the file and what is wrong in it.
    """
    import clothgym as cg

    if not text.endswith(".json"):
        return cg.Fidelity.preset(text)
    try:
        return cg.Fidelity.from_json(Path(text).read_text(encoding="utf-8"))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{text}: {error}") from error


def _mesh_scene(path: Path, settings: dict[str, Any]) -> Any:
    """A user's own mesh as the only cloth of a scene."""
    import clothgym as cg
    from clothgym.commands.untangle import read_mesh

    vertices, faces, _ = read_mesh(path, None)
    pins = settings.pop("pins", [])
    lowest = None if pins else float(vertices[:, 1].min())
    ground, material = settings.pop("ground", lowest), settings.pop("material", "cotton")
    if settings:
        raise ValueError(f"--set {min(settings)}: a mesh takes material, pins and ground")
    if not isinstance(pins, list) or not all(isinstance(pin, int) for pin in pins):
        raise ValueError(f"--set pins={pins!r}: expected a list of vertex ids, such as [0, 16]")
    cloth = cg.Cloth((vertices, faces), material, pins, name=path.stem)
    return cg.Scene((cloth,), ground=ground, name=path.stem)


def _read_scene(name: str, settings: dict[str, Any], seed: int) -> Any:
    import clothgym as cg

    if Path(name).suffix not in ("", ".json"):
        return _mesh_scene(Path(name), dict(settings))
    if not name.endswith(".json"):
        if seed and "seed" not in settings and any(p.name == "seed" for p in cg.scenes.describe(name).parameters):
            settings = {**settings, "seed": seed}
        return cg.scenes.make(name, **settings)
    if settings:
        raise ValueError(f"--set {next(iter(settings))}: a scene file has no parameters; edit {name} instead")
    try:
        return cg.Scene.from_json(Path(name).read_text(encoding="utf-8"))
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{name}: not a scene: {error}") from error


def as_plain(value: Any) -> Any:
    """JSON values of a mapping or dataclass."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    return json_ready(dict(value) if isinstance(value, Mapping) else value)


@contextlib.contextmanager
def _recording(simulation: Any, path: Path | None) -> Iterator[Any]:
    """Yields `log(step)`; the file is closed, and readable so far, however the run ends."""
    if path is None:
        yield lambda step: None
        return
    from clothgym.recording.rerun_log import RerunLog

    with RerunLog(path) as recording:
        recording.open_simulation(simulation)
        yield lambda step: recording.log_simulation(step, simulation, scalars=_scalars(simulation))


def _scalars(simulation: Any) -> dict[str, float]:
    """The metrics that are plain numbers, for the time series of a recording."""
    metrics = as_plain(simulation.metrics())
    return {k: float(v) for k, v in metrics.items() if isinstance(v, int | float) and not isinstance(v, bool)}


@contextlib.contextmanager
def _pictures(simulation: Any, folder: Path | None) -> Iterator[Any]:
    """Yields `draw(step)`, which writes `frame_00000.png` and so on."""
    if folder is None:
        yield lambda step: None
        return
    from clothgym.recording.frames import Camera, save_png
    from clothgym.recording.pictures import draw

    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--frames = {str(folder)!r}: not a folder")
    folder.mkdir(parents=True, exist_ok=True)
    camera = Camera.framing(_view(simulation), aspect=4 / 3)

    def write(step: int) -> None:
        save_png(folder / f"frame_{step:05d}.png", draw(simulation, camera, 640, 480, antialias=2))

    yield write


def _view(simulation: Any) -> np.ndarray:
    """(N, 3) points that the fixed camera holds: the start, and what lies below it as far as cloth may fall or swing,
    down to the ground if there is one [m]."""
    from clothgym.recording.pictures import everything

    start = everything(simulation)
    ground = simulation.scene.ground
    lowest = start[:, 1].min() - np.ptp(start, axis=0).max() if ground is None else min(ground, start[:, 1].min())
    corners = [(x, lowest, z) for x in _ends(start[:, 0]) for z in _ends(start[:, 2])]
    return np.concatenate([start, corners])


def _ends(values: np.ndarray) -> tuple[float, float]:
    return float(values.min()), float(values.max())
