"""`clothgym drape`: sews a pattern onto a body, drapes it, reports whether it is worn; mesh, recording, pictures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from clothgym import materials
from clothgym.arrays import FloatArray, IntArray, check_choice, check_number
from clothgym.benchmarks.report import Table, json_ready, write_atomically
from clothgym.commands import JsonOption, Stopped, answer, ctrl_c_between_steps, progress_bar, reserved_stdout, say
from clothgym.commands.run import read_fidelity

_HELP = """Sews a pattern onto a body and lets it hang until it rests; says whether the body wears it.

PATTERN is a pattern of the package, which is cut to the body, or a GarmentCode file (.json), BODY a body of the package or
any mesh that trimesh reads (y up, metres, unless --up and --unit say otherwise). A sequence of its vertices, as BODY (a folder
of meshes, or an .npz with vertices (T, V, 3) and faces) or as --frames, is played after the garment hangs on its first shape.
Pictures go into the folder of --pictures,
else beside --out with its name in front, else into `logs/drape/<pattern>_<body>/`.

Exit code: 0 worn, 1 not worn (everything is written and reported all the same), 2 bad input, 130 stopped.
"""

FORMATS = ("ply", "obj", "glb", "off", "stl")
"""Endings of meshes that can be written."""

_UNITS = {
    "contour_length": "m",
    "penetration_p999": "m",
    "penetration_max": "m",
    "contact_gap_median": "m",
    "contact_gap_p99": "m",
    "shift": "m",
    "mean_speed": "m/s",
    "p99_speed": "m/s",
    "simulated_seconds": "s",
    "seconds": "s",
}


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("drape", help=_HELP)(drape)


def drape(
    pattern: Annotated[
        str, typer.Argument(metavar="PATTERN", help="A pattern of the package (skirt, ...), or a file.")
    ],
    body: Annotated[
        str,
        typer.Option("--body", metavar="BODY", help="female, male, a mesh file, or a sequence: a folder or an .npz."),
    ],
    pose: Annotated[
        str, typer.Option("--pose", metavar="P", help="Of a body of the package: rest, a_pose, t_pose, arms_down, ...")
    ] = "rest",
    fit: Annotated[bool, typer.Option("--fit/--no-fit", help="Move the pattern's placement to the body.")] = True,
    fidelity: Annotated[
        str, typer.Option("--fidelity", metavar="F", help="draft, balanced, accurate, or a .json file.")
    ] = "balanced",
    edge_length: Annotated[
        float, typer.Option("--edge-length", metavar="M", help="Of the garment's triangles [m].")
    ] = 0.02,
    mesher: Annotated[
        str, typer.Option("--mesher", metavar="M", help="triangles, or quads: a grid in each panel.")
    ] = "triangles",
    grid: Annotated[
        str | None,
        typer.Option("--grid", metavar="CxR", help="Columns x rows of vertices of each panel.", show_default=False),
    ] = None,
    closing: Annotated[
        str, typer.Option("--closing", metavar="C", help="weld: seams closed first, or forces along them.")
    ] = "weld",
    self_collision: Annotated[
        bool, typer.Option("--self-collision/--no-self-collision", help="Whether the cloth feels itself.")
    ] = True,
    animate: Annotated[
        str | None,
        typer.Option("--animate", metavar="walk", help="Then the body walks on the spot.", show_default=False),
    ] = None,
    walk_seconds: Annotated[
        float,
        typer.Option("--walk-seconds", metavar="S", help="How long it walks, or a sequence is played at most [s]."),
    ] = 6.0,
    frames: Annotated[
        str | None,
        typer.Option(
            "--frames",
            metavar="FILE",
            help="What a body file's vertices do: .npy (T, V, 3), .npz or a folder.",
            show_default=False,
        ),
    ] = None,
    frame_rate: Annotated[
        float | None, typer.Option("--frame-rate", metavar="R", help="Frames a second; 30.", show_default=False)
    ] = None,
    material: Annotated[
        str, typer.Option("--material", metavar="NAME", help=f"{', '.join(materials.MATERIALS)}.")
    ] = "cotton",
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="S", help="Ends a drape that does not come to rest [s].")
    ] = 6.0,
    unit: Annotated[
        str | None, typer.Option("--unit", metavar="m|cm|mm", help="Of a body file.", show_default=False)
    ] = None,
    up: Annotated[
        str | None, typer.Option("--up", metavar="y|z", help="Axis of a body file that points up.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="MESH",
            help="Writes the draped garment (.ply, .obj, .glb, .off, .stl); an OBJ has the flat pattern as UVs [m].",
            show_default=False,
        ),
    ] = None,
    body_out: Annotated[
        Path | None,
        typer.Option("--body-out", metavar="MESH", help="Writes the body as it stood.", show_default=False),
    ] = None,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="FILE.rrd", help="Writes a rerun recording.", show_default=False)
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", metavar="DIR", help="Folder of the pictures.", show_default=False)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    check_number(edge_length, "--edge-length", 0.002, 0.5)
    check_number(seconds, "--seconds", 0.0, 600.0)
    check_choice(material, "--material", tuple(materials.MATERIALS))
    _check_targets({"--out": out, "--body-out": body_out, "--record": record}, {"PATTERN": pattern, "--body": body})
    if pictures is not None and pictures.exists() and not pictures.is_dir():
        raise ValueError(f"--pictures = {str(pictures)!r}: not a folder")
    from clothgym.pattern import Pattern, names
    from clothgym.rig import NAMES

    check_choice(mesher, "--mesher", ("triangles", "quads"))
    check_choice(closing, "--closing", ("weld", "forces"))
    check_number(walk_seconds, "--walk-seconds", 0.0, 600.0)
    if animate is not None:
        check_choice(animate, "--animate", ("walk",))
        check_choice(body, "--animate: --body", NAMES)
    choices = {
        "fit": fit,
        "edge_length": edge_length,
        "mesher": mesher,
        "grid": _grid(grid),
        "closing": closing,
        "self_collision": self_collision,
        "material": material,
        "seconds": seconds,
    }
    with reserved_stdout(as_json):
        wearer, how = _load_body(body, pose, unit, up, frames, frame_rate), read_fidelity(fidelity)
        wearer, motion = dataclasses.replace(wearer, motion=None), wearer.motion
        given: Any = (
            pattern if pattern in names() else Pattern.load(pattern)
        )  # those of the package are cut to the body
        _make_folders(pictures, *(path.parent for path in (out, body_out) if path is not None))
        result = _drape(given, wearer, how, choices, record)
        walked = None
        if animate is not None:
            walked = _walk(result, pose, walk_seconds)
        elif motion is not None:
            walked = _play(result, motion, walk_seconds)
        name = pattern if isinstance(given, str) else given.name
        images = _write_pictures(result, *_picture_place(name, wearer.name, out, pictures))
        if out is not None:
            write_atomically(out, encode_mesh(out, result.positions, result.faces, result.garment.rest_corners))
        if body_out is not None:
            write_atomically(body_out, encode_mesh(body_out, wearer.mesh.vertices, wearer.mesh.faces))
    asked = {
        "pattern": pattern,
        "body": body,
        "pose": pose,
        "fit": fit,
        "fidelity": fidelity,
        "edge_length": edge_length,
        "mesher": mesher,
        "closing": closing,
        "material": material,
    }
    files = {"out": out, "body_out": body_out, "record": record}
    notes = {"notes": list(result.notes), **({} if walked is None else {"walk": walked})}
    document = json_ready({**asked, **result.report, **notes, **files, "pictures": images})
    answer(document, _tables(document, asked), as_json)
    if not as_json:
        for note in result.notes:
            say(note)
    if not document["worn"]:
        say(f"{name} on {wearer.name}: not worn: {_what_is_wrong(document)}")
        raise typer.Exit(1)
    if walked is not None and walked["worn"] is False:
        say(f"{name} on {wearer.name}: worn, but not after the {'walk' if animate else 'sequence'}")
        raise typer.Exit(1)


def _load_body(source: str, pose: str, unit: str | None, up: str | None, frames: str | None, rate: float | None) -> Any:
    from clothgym import body, body_sequence

    if frames is not None or rate is not None:
        check_choice(pose, "--frames: --pose", ("rest",))
        return body_sequence.load(source, frames, rate, unit, up)
    return body.load(source, pose=pose, unit=unit, up=up)


def _grid(text: str | None) -> tuple[int, int] | None:
    """Columns and rows from "12x14"."""
    if text is None:
        return None
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--grid = {text!r}: expected columns x rows, as in 12x14")
    return int(parts[0]), int(parts[1])


def _walk(result: Any, pose: str, seconds: float) -> dict[str, Any]:
    """What `clothgym.dressing.walk` reports, with progress and Ctrl-C."""
    from clothgym.dressing import walk

    with ctrl_c_between_steps() as may_stop, progress_bar(f"{result.garment.name}: walk", seconds) as bar:

        def on_frame(simulation: Any) -> None:
            bar(simulation.time, "walk", seconds)
            may_stop()

        try:
            return dict(walk(result, seconds, pose=pose, on_frame=on_frame).report)
        except KeyboardInterrupt:
            raise Stopped("stopped while walking; nothing was written") from None


def _play(result: Any, motion: Any, most: float) -> dict[str, Any]:
    """What `clothgym.dressing.play` reports, with progress and Ctrl-C."""
    from clothgym.dressing import play

    seconds = min(most, float(motion.times[-1]))
    with ctrl_c_between_steps() as may_stop, progress_bar(f"{result.garment.name}: moving", seconds) as bar:

        def on_frame(simulation: Any) -> None:
            bar(simulation.time, "moving", seconds)
            may_stop()

        try:
            return dict(play(result, motion, seconds, on_frame).report)
        except KeyboardInterrupt:
            raise Stopped("stopped while the body moved; nothing was written") from None


def _drape(pattern: Any, wearer: Any, fidelity: Any, choices: dict[str, Any], record: Path | None) -> Any:
    """What `clothgym.dressing.drape` gives; with progress, Ctrl-C and a recording."""
    from clothgym.dressing import drape

    recording = _Recording(record)
    seen = _Seen()
    try:
        with (
            recording,
            ctrl_c_between_steps() as may_stop,
            progress_bar(f"{getattr(pattern, 'name', pattern)} on {wearer.name}", 1.0) as bar,
        ):

            def progress(phase: str, done: float, total: float, text: str = "") -> None:
                seen.phase, seen.text = phase, text
                bar(done, f"{phase}: {text}" if text else phase, total)
                may_stop()

            def on_step(simulation: Any) -> None:
                seen.phase, seen.time = "drape", simulation.time
                recording.log(simulation)
                may_stop()

            return drape(pattern, wearer, fidelity=fidelity, progress=progress, on_step=on_step, **choices)
    except KeyboardInterrupt:
        kept = f"; kept what there is of {record}" if recording.steps else "; nothing was written"
        raise Stopped(f"stopped {seen.words()}{kept}") from None


@dataclass
class _Seen:
    """Where the work stands, for the line that Ctrl-C leaves."""

    phase: str = "at the start"
    text: str = ""
    time: float = 0.0

    def words(self) -> str:
        attempt = f" ({self.text})" if self.text else ""
        if self.phase == "drape":
            return f"after {self.time:.2f} s of draping{attempt}"
        return f"while sewing{attempt}" if self.phase == "sew" else self.phase


class _Recording:
    """A recording of the drape, however often it starts anew; without a path it does nothing.

    A garment that is not worn at the end is sewn and draped again: the recording holds the last attempt.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.steps = 0
        self._simulation: Any = None
        self._log: Any = None
        if path is not None:
            self._new()  # a path that cannot be written is told before the work

    def _new(self) -> None:
        from clothgym.recording.rerun_log import RerunLog

        if self._log is not None:
            self._log.close(reason="drape started anew")
        self._log = RerunLog(self.path)

    def log(self, simulation: Any) -> None:
        """One step, or the start when it is another simulation than before."""
        if self._log is None:
            return
        if simulation is not self._simulation:
            if self._simulation is not None:
                self._new()
            self._log.open_simulation(simulation)
            self._simulation, self.steps = simulation, 0
        metrics = simulation.metrics()
        scalars = {k: float(v) for k, v in metrics.items() if isinstance(v, int | float) and k != "time"}
        self._log.log_simulation(self.steps, simulation, scalars=scalars)
        self.steps += 1

    def __enter__(self) -> _Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        if self._log is None:
            return
        self._log.__exit__(kind, error, trace)
        if self._simulation is None and self.path is not None:
            self.path.unlink(missing_ok=True)  # nothing was draped: no empty file stays


# Pictures


def _picture_place(pattern: str, body: str, out: Path | None, folder: Path | None) -> tuple[Path, str]:
    """Folder of the pictures, and what their names start with."""
    if folder is not None:
        return folder, ""
    if out is not None:
        return out.parent, f"{out.stem}_"
    return Path("logs") / "drape" / f"{pattern}_{body}", ""


def _write_pictures(result: Any, folder: Path, prefix: str) -> list[Path]:
    """front, back, side, and all of them on one sheet (`views`)."""
    from clothgym.recording.frames import save_png, tile
    from clothgym.recording.pictures import draw_views

    views = draw_views(result.simulation)
    sheet = tile(list(views.values()), list(views), columns=len(views))
    return [save_png(folder / f"{prefix}{name}.png", image) for name, image in {**views, "views": sheet}.items()]


# Meshes


def _ending(path: Path, name: str) -> str:
    ending = path.suffix.lstrip(".").lower()
    if ending not in FORMATS:
        what = repr(path.suffix) if path.suffix else "a file without ending"
        raise ValueError(f"{name} = {str(path)!r}: cannot write {what}: expected .{', .'.join(FORMATS)}")
    return ending


def _check_targets(targets: dict[str, Path | None], sources: dict[str, str]) -> None:
    """Meshes have endings that can be written, and nothing is written over what is read or over each other."""
    taken = {Path(source).resolve(): name for name, source in sources.items() if Path(source).is_file()}
    for name, path in targets.items():
        if path is None:
            continue
        if name != "--record":  # the recorder checks its own
            _ending(path, name)
        if path.is_dir():
            raise ValueError(f"{name} = {str(path)!r}: is a folder")
        if path.resolve() in taken:
            raise ValueError(f"{name} = {str(path)!r}: is {taken[path.resolve()]} too")
        taken[path.resolve()] = name


def _make_folders(*folders: Path | None) -> None:
    """Made before the work, so that a place where nothing can be written is told before it."""
    for folder in folders:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)


def encode_mesh(path: Path, vertices: FloatArray, faces: IntArray, flat: FloatArray | None = None) -> bytes:
    """The bytes of a mesh file in the format of its ending.

    Args:
        path: tells the format.
        vertices, faces: (V, 3) [m], (F, 3); vertices keep their order.
        flat: (F, 3, 2) corners of each face in the flat pattern [m]; an OBJ keeps them as texture coordinates.
    """
    import trimesh

    ending = _ending(path, "path")
    if ending == "obj":
        return _obj(np.asarray(vertices), np.asarray(faces), flat)
    content: Any = trimesh.Trimesh(vertices, faces, process=False).export(file_type=ending)
    return content.encode("utf-8") if isinstance(content, str) else content


def _obj(vertices: FloatArray, faces: IntArray, flat: FloatArray | None) -> bytes:
    """An OBJ in which a seam's vertices stay whole and have a texture coordinate in each panel; numbers survive
    exactly."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    if flat is None:
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    else:
        places, corner = np.unique(np.asarray(flat, float).reshape(-1, 2), axis=0, return_inverse=True)
        lines += [f"vt {u!r} {v!r}" for u, v in places.tolist()]
        ids = np.concatenate([faces + 1, corner.reshape(-1, 3) + 1], axis=1).tolist()
        lines += [f"f {a}/{ta} {b}/{tb} {c}/{tc}" for a, b, c, ta, tb, tc in ids]
    return ("\n".join(lines) + "\n").encode()


# What is told


def _tables(document: dict[str, Any], asked: dict[str, Any]) -> list[Table]:
    apart = {*asked, "openings", "notes", "walk", "out", "body_out", "record", "pictures"}
    rows = [(_labelled(name), value) for name, value in document.items() if name not in apart]
    openings = [
        (k, opening["expected"], ", ".join(map(str, opening["through"])) or "nothing", opening["right"])
        for k, opening in enumerate(document["openings"], 1)
    ]
    written = [(name.replace("_", " "), document[name]) for name in ("out", "body_out", "record") if document[name]]
    written += [("picture", name) for name in document["pictures"]]
    return [
        Table(
            f"{document['pattern']} on {document['body']}",
            ("what", "value"),
            [(_labelled(k), v) for k, v in asked.items()],
        ),
        Table("Drape", ("quantity", "value"), rows, "strains and penetrations: of the garment as it hangs at the end"),
        Table("Openings", ("opening", "should hold", "holds", "right"), openings),
        *(
            [Table("Walk", ("quantity", "value"), [(k, v) for k, v in document["walk"].items() if k != "openings"])]
            if "walk" in document
            else []
        ),
        Table("Written", ("what", "file"), written),
    ]


def _labelled(name: str) -> str:
    unit = "m" if name == "edge_length" else _UNITS.get(name)
    return name.replace("_", " ") + (f" [{unit}]" if unit else "")


def _what_is_wrong(document: dict[str, Any]) -> str:
    """The openings through which not the right part of the body goes."""
    wrong = [
        f"the opening for {o['expected']} holds {' and '.join(map(str, o['through'])) or 'nothing'}"
        for o in document["openings"]
        if not o["right"]
    ]
    return "; ".join(wrong) or "see the report"
