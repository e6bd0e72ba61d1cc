"""The collider by itself: what drawing and asking cost, and how far its answers are from exact distances."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from clothgym import body as bodies
from clothgym import rig
from clothgym.arrays import BoolArray, FloatArray, IntArray
from clothgym.benchmarks.frame import Case, Row
from clothgym.benchmarks.report import Table
from clothgym.body import Body
from clothgym.detection.body_boxes import BodyBoxes
from clothgym.detection.body_maps import BodyMaps
from clothgym.detection.body_mesh import BodyMesh
from clothgym.kernels import body_map, raster

KINDS = ("draw", "ask", "accuracy")
TOLERANCE, MARGIN = 0.003, 0.015
_REPEATS = 15
_SHIRT = np.array([[-0.45, 0.85, -0.3], [0.45, 1.45, 0.3]])
"""[m] around the trunk and the upper arms."""
_FORMS = ("face", "interpolated", "bytes", "paper")
_CROSSED = "arms before the trunk"
_REGIONS = ("trunk", "arms", "legs")
_ASKED = 0.005
"""[m] tolerance at which accuracy is measured."""
_COVERED = 0.008
"""[m] points nearer than this to the surface count for the error; further outside must not be felt."""


def cases(quick: bool) -> list[Case]:
    """Drawing, asking, accuracy."""
    found = [
        Case(f"draw/{size}/{views}", {"kind": "draw", "map_size": size, "views": views})
        for size in ((360,) if quick else (180, 360, 720))
        for views in ("z", "zyx")
    ]
    found.append(Case("ask", {"kind": "ask", "cuts": [3, 4] if quick else [3, 4, 5, 6]}))
    poses = [("female", "a_pose"), ("female", "arms_down")]
    if not quick:
        poses += [("male", "a_pose"), ("female", "walk:0.25"), ("female", "walk:0.5"), ("female", _CROSSED)]
    for name, pose in poses:
        for size in (360,) if quick else (180, 360, 720):
            for views in ("z", "zx", "zy", "zyx"):
                for form in _FORMS:
                    if form != "face" and (size != 360 or views != "z"):
                        continue
                    parameters = {"body": name, "pose": pose, "map_size": size, "views": views, "form": form}
                    found.append(
                        Case(f"accuracy/{name}/{pose}/{size}/{views}/{form}", {"kind": "accuracy", **parameters})
                    )
    return found


def prepare() -> None:
    """Compiles every kernel that a case uses."""
    run({"kind": "ask", "cuts": [1]})
    run({"kind": "draw", "map_size": 60, "views": "zyx"})
    run({"kind": "accuracy", "body": "female", "pose": "a_pose", "map_size": 60, "views": "z", "form": "paper"})


def run(parameters: dict[str, Any]) -> dict[str, Any]:
    """One case of `cases`."""
    chosen: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {"draw": _draw, "ask": _ask, "accuracy": _accuracy}
    return chosen[parameters["kind"]](parameters)


def _median_ms(work: Callable[[], object], repeats: int = _REPEATS) -> float:
    times = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - began))
    return statistics.median(times)


def _draw(parameters: dict[str, Any]) -> dict[str, Any]:
    """Maps of the female body, everywhere and around a shirt."""
    body = bodies.load("female", "a_pose")
    maps = BodyMaps([body], parameters["map_size"], MARGIN, views=parameters["views"])
    x = body.mesh.vertices
    return {
        "triangles": len(body.mesh.faces),
        "texels": len(maps.map.planes),
        "pixel": maps.pixel,
        "whole_ms": _median_ms(lambda: maps.render(x)),
        "near_ms": _median_ms(lambda: maps.render(x, near=_SHIRT)),
        "moving_ms": _median_ms(lambda: maps.render(x, x - 0.001, 0.01, _SHIRT)),
    }


def _ask(parameters: dict[str, Any]) -> dict[str, Any]:
    """Queries of 10,000 cloth vertices against balls of more and more triangles; all colliders in turn, medians.

    Neighbours in space are neighbours in order, as in a cloth; a third of them touch.
    """
    import trimesh

    rng = np.random.default_rng(0)
    side = np.linspace(-0.09, 0.09, 100)
    xy = np.stack(np.meshgrid(side, side), axis=2).reshape(-1, 2)
    gap = rng.uniform(-0.002, 0.01, len(xy))
    radius = np.sqrt(np.maximum(0.15**2 - (xy**2).sum(axis=1), 0.0)) + gap
    points = np.column_stack([xy, radius])
    distances, normals = np.empty(len(points)), np.empty((len(points), 3))
    work: dict[tuple[int, str], Callable[[], object]] = {}
    counts: dict[int, BodyBoxes] = {}
    for cut in parameters["cuts"]:
        ball = trimesh.creation.icosphere(cut, 0.15)
        body, triangles = Body((ball.vertices, ball.faces)), len(ball.faces)
        for views in ("z", "zy", "zyx"):
            maps = BodyMaps([body], 360, MARGIN, views=views).map
            work[triangles, f"maps {views}"] = partial(body_map.query, points, maps, TOLERANCE, distances, normals)
        counts[triangles] = BodyBoxes(ball.vertices, ball.faces)
        work[triangles, "boxes"] = partial(counts[triangles].query, points, MARGIN)
        work[triangles, "exact tree"] = partial(BodyMesh(ball.vertices, ball.faces).signed_distance, points)
    times: dict[tuple[int, str], list[float]] = {key: [] for key in work}
    keys = list(work)
    for n in range(_REPEATS):
        for key in (
            keys[n % len(keys) :] + keys[: n % len(keys)]
        ):  # what comes first finds the caches as others left them
            ask = work[key]
            ask()
            began = time.process_time()
            ask()
            times[key].append(1e9 * (time.process_time() - began) / len(points))
    return {
        "points": len(points),
        "ns": [[triangles, name, statistics.median(values)] for (triangles, name), values in times.items()],
        "box_tests": [[n, b.box_tests / (2 * _REPEATS * len(points))] for n, b in counts.items()],
        "face_tests": [[n, b.face_tests / (2 * _REPEATS * len(points))] for n, b in counts.items()],
    }


def _accuracy(parameters: dict[str, Any]) -> dict[str, Any]:
    """Answers around the skin, -12 to +30 mm, against exact signed distances; head, hands and feet left out."""
    name, pose, form = parameters["body"], parameters["pose"], parameters["form"]
    skin = rig.load(name)
    body = Body((skin.posed(_pose(skin, pose)), skin.faces))
    vertices, faces = body.mesh.vertices, body.mesh.faces
    points, of = _around(vertices, faces, _covered_faces(skin), 20_000)
    region = np.array([0, 1, 1, 2, 2])[skin.face_parts()[of]]
    exact = BodyMesh(vertices, faces).signed_distance(points)
    if form == "paper":
        felt, error = _paper_answers(body, parameters["map_size"], points, exact)
    else:
        maps = BodyMaps([body], parameters["map_size"], MARGIN, form, parameters["views"], _ASKED)
        found, _ = maps.query(points, _ASKED)
        felt = np.isfinite(found)
        error = np.abs(found - exact)[felt & (np.abs(exact) < _COVERED)]
    boxes, box_error = BodyBoxes(vertices, faces, skin.face_parts()), None
    if form == "face" and parameters["views"] == "z":
        seen, _ = boxes.query(points, _COVERED)
        box_error = float(np.abs(seen - exact)[np.isfinite(seen)].max())
    return {
        "points": len(points),
        "error_median": float(np.median(error)),
        "error_p95": float(np.percentile(error, 95)),
        "error_p99": float(np.percentile(error, 99)),
        "deep_missed": float((~felt[exact < -0.001]).mean()),
        "shell_missed": float((~felt[exact < _ASKED - 3e-4]).mean()),
        "filled": float(felt[exact > _COVERED].mean()),
        "by_region": [
            [
                name,
                *(
                    float(np.mean(which[near & (region == k)]))
                    for which, near in (
                        (~felt, exact < _ASKED - 3e-4),
                        (~felt, exact < 0.002),
                        (felt, exact > _COVERED),
                    )
                ),
            ]
            for k, name in enumerate(_REGIONS)
        ],
        "boxes_error": box_error,
    }


def _covered_faces(skin: rig.Rig) -> BoolArray:
    """(F,) faces that garments may cover: neither head, nor hands, nor feet."""
    bare_bones = [n for n, bone in enumerate(skin.bones) if bone.startswith(("head", "hand", "foot", "ball"))
                  or bone.split("_")[0] in ("thumb", "index", "middle", "ring", "pinky")]  # fmt: skip
    weight = np.asarray(skin.weights)[:, bare_bones].sum(axis=1)
    return np.asarray((weight[skin.faces] < 0.1).all(axis=1))


def _pose(skin: rig.Rig, pose: str) -> Any:
    """What `Rig.posed` takes; a pose of the package, or both forearms in front of the belly."""
    if pose != _CROSSED:
        return pose
    from scipy.spatial.transform import Rotation

    turned = dict(skin.rotations("arms_down"))
    for side, inwards in (("l", -0.9), ("r", 0.9)):
        w, x, y, z = turned[f"lowerarm_{side}"]
        bent = Rotation.from_euler("y", inwards) * Rotation.from_euler("x", -1.3) * Rotation.from_quat([x, y, z, w])
        turned[f"lowerarm_{side}"] = np.roll(bent.as_quat(), 1)
    return turned


def _around(vertices: FloatArray, faces: Any, chosen: BoolArray, count: int) -> tuple[FloatArray, IntArray]:
    """Points near the chosen faces, and the face of each."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces[chosen], process=False)
    places, of = trimesh.sample.sample_surface(mesh, count, seed=0)
    offsets = np.random.default_rng(0).uniform(-0.012, 0.03, count)
    return np.asarray(places + offsets[:, None] * mesh.face_normals[of]), np.flatnonzero(chosen)[of]


def _paper_answers(body: Body, map_size: int, points: FloatArray, exact: FloatArray) -> tuple[BoolArray, FloatArray]:
    """The paper's own form: depth along z in the nearest texel, plus and minus the tolerance, one layer of pixels around
    [Vassilev 2001, 5.1, eq. 5, 9]; which points are felt, and the errors of depths near the surface."""
    from scipy.ndimage import distance_transform_edt

    maps = BodyMaps([body], map_size, MARGIN)
    view = maps.map.one
    scale, x = 1.0 / view.pixel, body.mesh.vertices
    image = np.ones((len(x), 4))
    image[:, 0] = (x[:, 0] - view.left) * scale
    image[:, 1] = (view.bottom + view.rows * view.pixel - x[:, 1]) * scale
    image[:, 2] = x[:, 2].max() + 1.0 - x[:, 2]
    layers = raster.new_layers(2, view.rows, view.columns)
    raster.rasterise(np.ascontiguousarray(image), body.mesh.faces, 0.0, layers)
    depth = x[:, 2].max() + 1.0 - layers.depth.astype(float)[:, ::-1]
    filled = np.isfinite(depth).all(axis=0)
    gap, (row, column) = distance_transform_edt(~filled, return_indices=True)
    shown = gap <= 1.0
    depth = depth[:, row, column]
    at_row = np.clip(((points[:, 1] - view.bottom) * scale).astype(int), 0, view.rows - 1)
    at_column = np.clip(((points[:, 0] - view.left) * scale).astype(int), 0, view.columns - 1)
    front, back = depth[0, at_row, at_column], depth[1, at_row, at_column]
    over = shown[at_row, at_column]
    signed = np.maximum(points[:, 2] - front, back - points[:, 2])
    felt = over & (signed < _ASKED)
    return felt, np.abs(signed - exact)[over & (np.abs(exact) < _COVERED)]


def tables(rows: list[Row]) -> list[Table]:
    """Drawing, asking, accuracy."""
    found = []
    by_kind = {kind: [row for row in rows if row["parameters"].get("kind") == kind] for kind in KINDS}
    if by_kind["draw"]:
        drawn: list[tuple[Any, ...]] = [
            (p["map_size"], p["views"], r["triangles"], r["texels"], 1e3 * r["pixel"],
             r["whole_ms"], r["near_ms"], r["moving_ms"])
            for p, r in ((row["parameters"], row["result"]) for row in by_kind["draw"])
        ]  # fmt: skip
        drawn_columns = (
            "pixels",
            "views",
            "triangles",
            "texels",
            "texel [mm]",
            "all [ms]",
            "near a shirt [ms]",
            "moving [ms]",
        )
        note = "to reach at 360 pixels along z: 6 ms, near a shirt 4 ms; moving: with velocities, near a shirt"
        found.append(Table("Drawing the maps", drawn_columns, drawn, note))
    for row in by_kind["ask"]:
        found.append(_ask_table(row["result"]))
    if by_kind["accuracy"]:
        cells = []
        for row in by_kind["accuracy"]:
            p, r = row["parameters"], row["result"]
            cells.append(
                (p["body"], p["pose"], p["map_size"], p["views"], p["form"],
                 *(1e3 * r[f"error_{q}"] for q in ("median", "p95", "p99")),
                 *(1e2 * r[q] for q in ("deep_missed", "shell_missed", "filled")))
            )  # fmt: skip
        columns = (
            "body", "pose", "pixels", "views", "form", "error median [mm]", "p95", "p99", "inside missed [%]",
            "within 5 mm missed [%]", "filled space [%]",
        )  # fmt: skip
        note = (
            "Errors of distances within 8 mm of the skin; inside: deeper than 1 mm; filled: felt although further out than "
            "8 mm. 'paper': depth along z and one layer of pixels; 'bytes': its normals as 8-bit colours."
        )
        found.append(Table("Answers against exact distances", columns, cells, note))
        found.append(_regions_table(by_kind["accuracy"]))
    return found


def _regions_table(rows: list[Row]) -> Table:
    """What more views buy where one pair sees least: arms before and beside the trunk, armpits, between the legs."""
    cells = []
    for row in rows:
        p, r = row["parameters"], row["result"]
        if p["form"] == "face" and p["map_size"] == 360 and "by_region" in r:
            shares = [1e2 * share for _, *values in r["by_region"] for share in values]
            cells.append((p["body"], p["pose"], p["views"], *shares))
    columns = ["body", "pose", "views"]
    for name in _REGIONS:
        columns += [f"{name}: within 5 mm missed [%]", "within 2 mm", "filled"]
    note = "360 pixels. What several views miss lies where an arm or a breast begins in front of something else."
    return Table("Answers by region", tuple(columns), cells, note)


def _ask_table(result: dict[str, Any]) -> Table:
    ns = {(triangles, name): value for triangles, name, value in result["ns"]}
    names = list(dict.fromkeys(name for _, name in ns))
    boxes, faces = dict(map(tuple, result["box_tests"])), dict(map(tuple, result["face_tests"]))
    cells = []
    for triangles in dict.fromkeys(t for t, _ in ns):
        cells.append((triangles, *(ns[triangles, name] for name in names), boxes[triangles], faces[triangles]))
    spread = [ns[t, "maps z"] for t, name in ns if name == "maps z"]
    note = f"to reach: 25 ns with maps, equal within 15 % (here {100 * (max(spread) / min(spread) - 1):.0f} %)"
    columns = ("triangles", *(f"{name} [ns]" for name in names), "boxes a point", "faces a point")
    return Table(
        f"Asking for {result['points']} vertices, ns each", columns, cells, note if math.isfinite(spread[0]) else ""
    )
