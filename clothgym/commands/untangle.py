"""`clothgym untangle`: reads a mesh, writes the untangled one, reports."""

from __future__ import annotations

import io
import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from clothgym.arrays import BoolArray, FloatArray, IntArray, as_faces, as_points, check_number
from clothgym.benchmarks.report import Table, write_atomically
from clothgym.commands import JsonOption, answer, reserved_stdout, say

_HELP = """Reads a mesh (any format that trimesh reads), removes its intersections, writes it, reports.

Vertex order, faces and, for OBJ to OBJ, all other lines of the file stay as they are. Vertices at exactly the same
place (an STL, a seam of a texture) move as one unless `--no-weld` is given. What is reported as "after" is measured on
the file as written. IN may be OUT: the old file stays until the new one is whole.

Exit code: 0 no intersection is left, 1 some are left (OUT is written all the same), 2 bad input.
"""

_STRATEGIES = (
    "none, local, global, exact, area, gia, hybrid, coherence, stall, annealed, flatten, or package.module:Name."
)


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("untangle", help=_HELP)(untangle)


def untangle(
    source: Annotated[Path, typer.Argument(metavar="IN", help="The mesh to read.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="The mesh to write.")],
    strategy: Annotated[str, typer.Option("--strategy", metavar="S", help=_STRATEGIES)] = "hybrid",
    passes: Annotated[int, typer.Option("--passes", metavar="N", help="Largest number of corrections.")] = 100,
    fixed: Annotated[
        Path | None,
        typer.Option(
            "--fixed",
            metavar="FILE",
            help="Vertices that do not move: ids as text or JSON (counted from 0), or a .npy of ids or of V booleans.",
            show_default=False,
        ),
    ] = None,
    weld: Annotated[
        bool, typer.Option("--weld/--no-weld", help="Treat vertices at exactly the same place as one.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    check_number(passes, "--passes", 1, 1_000_000, integer=True)
    with reserved_stdout(as_json):
        document = _untangle(source, target, strategy, passes, fixed, weld)
    rows = [(name.replace("_", " "), value) for name, value in document.items() if name != "length_history"]
    answer(document, [Table("Untangling", ("what", "value"), rows, "lengths are in the unit of the file")], as_json)
    if not document["resolved"]:
        raise typer.Exit(1)


def _untangle(
    source: Path, target: Path, strategy: str, passes: int, fixed_file: Path | None, weld: bool
) -> dict[str, Any]:
    import clothgym as cg

    vertices, faces, encode = read_mesh(source, target)
    fixed = None if fixed_file is None else read_fixed(fixed_file, len(vertices))
    joined, first, member = _weld(vertices, faces, weld)
    if len(first) < len(vertices):
        say(f"{source}: {len(vertices) - len(first)} of {len(vertices)} vertices lie exactly on another: moved as one")
    joined_fixed = None
    if fixed is not None:
        joined_fixed = np.zeros(len(first), dtype=bool)
        joined_fixed[member[fixed]] = True
    before = cg.intersections(vertices[first], joined)
    started = time.perf_counter()
    result = cg.untangle(vertices[first], joined, strategy=strategy, passes=passes, fixed=joined_fixed)
    seconds = time.perf_counter() - started
    moved = np.asarray(result.vertices, dtype=np.float64)[member]
    if fixed is not None:
        moved[fixed] = vertices[fixed]
    write_atomically(target, encode(moved))

    written, written_faces, _ = read_mesh(target, None)
    joined, first, member = _weld(written, written_faces, weld)
    after = cg.intersections(written[first], joined)
    history = [float(length) for length in result.length_history]
    return {
        "input": str(source),
        "output": str(target),
        "vertices": len(vertices),
        "faces": len(faces),
        "fixed": 0 if fixed is None else int(fixed.sum()),
        "strategy": strategy,
        "hits_before": len(before.edge_triangle),
        "hits_after": len(after.edge_triangle),
        "length_before": float(before.length),
        "length_after": float(after.length),
        "passes": int(result.passes),
        "stop_reason": str(result.stop_reason),
        "largest_move": float(np.linalg.norm(moved - vertices, axis=1).max(initial=0.0)),
        "resolved": len(after.edge_triangle) == 0,
        "seconds": seconds,
        "length_history": history,
    }


def _weld(vertices: FloatArray, faces: IntArray, weld: bool) -> tuple[IntArray, IntArray, IntArray]:
    """Joins vertices at exactly the same place.

    Returns:
        Faces over the joined vertices (without those that lost a corner), the first vertex of each joined one, and
        the joined vertex of each vertex; order of first appearance.
    """
    if not weld:
        every = np.arange(len(vertices), dtype=np.int32)
        return faces, every, every
    _, first, inverse = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty(len(order), dtype=np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    member = rank[inverse.ravel()]
    joined = member[faces].reshape(-1, 3)
    whole = (joined[:, 0] != joined[:, 1]) & (joined[:, 1] != joined[:, 2]) & (joined[:, 2] != joined[:, 0])
    return np.ascontiguousarray(joined[whole], dtype=np.int32), first[order].astype(np.int32), member


# Files

Encode = Callable[[FloatArray], bytes]


def read_mesh(source: Path, target: Path | None) -> tuple[FloatArray, IntArray, Encode]:
    """Vertices (V, 3) and faces (F, 3) in the order of the file, and a function that makes the bytes of the target
    from moved vertices.

    Raises:
        ValueError: names the file and what is wrong: unknown ending, unreadable, no triangle, bad numbers.
        FileNotFoundError: no such file.
    """
    import trimesh

    ending = _ending(source, sorted(trimesh.available_formats()), "read")
    data = source.read_bytes()
    obj_text = data.decode("utf-8", errors="surrogateescape") if ending == "obj" else None
    options: dict[str, Any] = {}
    if obj_text is not None:
        # trimesh splits vertices at seams of the texture and repeats all of them for every material or group: it gets
        # the vertices and faces alone.
        data = _bare_obj(obj_text).encode("utf-8", errors="surrogateescape")
        options = {"maintain_order": True, "skip_materials": True}
    try:
        mesh = trimesh.load_mesh(io.BytesIO(data), file_type=ending, process=False, **options)
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{source}: cannot be read as {ending}: {reason}") from error
    try:
        if vertices.ndim != 2 or len(faces) == 0:
            raise ValueError("holds no triangle")
        points = as_points(vertices)
        triangles = as_faces(faces, len(points))
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error

    if target is None:
        return points, triangles, _cannot_encode
    target_ending = _ending(target, sorted(_written_formats()), "write")
    if target_ending == "obj" and obj_text is not None and len(_VERTEX_LINE.findall(obj_text)) == len(points):
        return points, triangles, lambda moved: _moved_obj(obj_text, moved)

    def encode(moved: FloatArray) -> bytes:
        mesh.vertices = moved
        options = {"digits": 17} if target_ending == "obj" else {}
        content: Any = mesh.export(file_type=target_ending, **options)  # type: ignore[arg-type]
        return content.encode("utf-8") if isinstance(content, str) else content

    return points, triangles, encode


def _cannot_encode(moved: FloatArray) -> bytes:
    raise AssertionError("this mesh was read to be measured")


def _written_formats() -> set[str]:
    """Endings of single files that trimesh writes."""
    return {"obj", "off", "ply", "stl", "glb"}


def _ending(path: Path, known: list[str], verb: str) -> str:
    ending = path.suffix.lstrip(".").lower()
    if ending not in known:
        raise ValueError(
            f"{path}: cannot {verb} {path.suffix or 'a file without ending'!r}: expected {', '.join(known)}"
        )
    return ending


_BARE_LINE = re.compile(r"^[ \t]*[vf][ \t].*$", re.MULTILINE)
_VERTEX_LINE = re.compile(r"^([ \t]*v[ \t]+)(\S+)([ \t]+)(\S+)([ \t]+)(\S+)", re.MULTILINE)


def _bare_obj(text: str) -> str:
    """The `v` lines, and the `f` lines with vertex ids alone."""
    return "\n".join(re.sub(r"/\S*", "", line) for line in _BARE_LINE.findall(text)) + "\n"


def _moved_obj(text: str, moved: FloatArray) -> bytes:
    """The OBJ with new coordinates and everything else as it was; numbers survive exactly."""
    rows = iter(moved.tolist())

    def replace(line: re.Match[str]) -> str:
        x, y, z = next(rows)
        head, _, gap, _, second_gap, _ = line.groups()
        return f"{head}{x!r}{gap}{y!r}{second_gap}{z!r}"

    return _VERTEX_LINE.sub(replace, text).encode("utf-8", errors="surrogateescape")


def read_fixed(path: Path, vertex_count: int) -> BoolArray:
    """(V,) bool: vertices that do not move.

    Args:
        path: `.npy` with V booleans or with ids, `.json` with a list of ids or of V booleans, otherwise text with ids
            (separated by blanks, commas or lines; `#` starts a comment). Ids count from 0.
        vertex_count: V.

    Raises:
        ValueError: names the file, the entry and the value.
        FileNotFoundError: no such file.
    """
    ending = path.suffix.lower()
    if ending == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except FileNotFoundError:
            raise
        except (ValueError, EOFError, OSError) as error:
            raise ValueError(f"{path}: not a .npy array of ids or booleans: {error}") from error
        if not isinstance(values, np.ndarray) or values.dtype.kind not in "biu":
            raise ValueError(f"{path}: expected ids or booleans, got {getattr(values, 'dtype', type(values).__name__)}")
        entries = values.ravel().tolist()
    elif ending == ".json":
        try:
            entries = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path}: not valid JSON: {error}") from error
        if not isinstance(entries, list):
            raise ValueError(f"{path}: expected a list of ids or booleans, got {type(entries).__name__}")
    else:
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: not a text file") from error
        words = [word for line in lines for word in line.partition("#")[0].replace(",", " ").split()]
        entries = [int(word) if re.fullmatch(r"[+-]?[0-9]+", word) else word for word in words]
    return _mask(path, entries, vertex_count)


def _mask(path: Path, entries: list[Any], vertex_count: int) -> BoolArray:
    if entries and all(isinstance(entry, bool) for entry in entries):
        if len(entries) != vertex_count:
            raise ValueError(f"{path}: {len(entries)} booleans, but the mesh has {vertex_count} vertices")
        return np.array(entries, dtype=bool)
    mask = np.zeros(vertex_count, dtype=bool)
    for number, entry in enumerate(entries):
        if not isinstance(entry, int) or isinstance(entry, bool) or not 0 <= entry < vertex_count:
            raise ValueError(f"{path}: entry {number} = {entry!r}: expected a vertex id in [0, {vertex_count - 1}]")
        mask[entry] = True
    return mask
