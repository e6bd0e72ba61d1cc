"""Bodies of a scene: from the package, from arrays, from files, and what is found while reading."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from clothgym import body, rig
from clothgym.body import Body
from clothgym.mesh import Mesh, grid


def _figure() -> trimesh.Trimesh:
    """A closed thing of human size standing on y = 0: 1.6 m high, deeper in front than behind."""
    shape = trimesh.creation.icosphere(2)
    x = np.asarray(shape.vertices) * (0.3, 0.8, 0.15) + (0.0, 0.8, 0.02)
    return trimesh.Trimesh(x, np.asarray(shape.faces), process=False)


def _volume(loaded: Body) -> float:
    return float(trimesh.Trimesh(loaded.mesh.vertices, loaded.mesh.faces, process=False).volume)


def test_a_body_copies_its_arrays_and_comes_back_from_json() -> None:
    shape = _figure()
    x, faces = np.array(shape.vertices), np.array(shape.faces)
    limb = rig.Limb("head", np.array([[0.0, 1.0, 0.0], [0.1, 1 / 3, 0.0]]), 1)
    made = Body((x, faces), name="ball", friction=0.1, limbs=(limb,))
    x[:] = 0.0
    assert made.mesh.vertices[:, 1].max() == 1.6
    assert made.mesh.vertices.dtype == np.float64
    assert made.mesh.faces.dtype == np.int32
    assert made.notes == ()
    with pytest.raises(ValueError, match="read-only"):
        made.mesh.faces[0, 0] = 1
    again = Body.from_json(json.loads(json.dumps(made.to_json())))
    assert np.array_equal(again.mesh.vertices, made.mesh.vertices)
    assert np.array_equal(again.mesh.faces, made.mesh.faces)
    assert np.array_equal(again.limbs[0].points, limb.points)
    assert (again.name, again.friction) == ("ball", 0.1)
    for values in (made.to_json() | {"colour": 1}, {k: v for k, v in made.to_json().items() if k != "friction"}):
        with pytest.raises(ValueError, match=r"body\.(colour|friction): unknown or missing field"):
            Body.from_json(values)
    for same in (Body(shape), Body(Mesh(shape.vertices, shape.faces)), Body([shape.vertices, shape.faces])):
        assert np.array_equal(same.mesh.faces, made.mesh.faces)


def test_bad_arrays_are_named() -> None:
    shape = _figure()
    x, faces = np.array(shape.vertices), np.array(shape.faces)
    hole = x.copy()
    hole[3, 1] = np.nan
    for mesh, message in (
        ((hole, faces), r"body 'b': vertices\[3, 1\] is nan"),
        ((x[:-1], faces), r"body 'b': faces\[\d+, \d\] is 161: no such vertex id"),
        ((x, faces[:3]), "body 'b': faces: 3 given; a body needs at least four"),
        ((x * (1.0, 0.0, 0.0), faces), "body 'b': faces: all 320 triangles have no area"),
        ("man.obj", "body 'b': mesh = 'man.obj': expected one of female, male"),
        (7, "body 'b': mesh: expected a Mesh.*got 7"),
    ):
        with pytest.raises(ValueError, match=message):
            Body(mesh, name="b")
    with pytest.raises(ValueError, match="body 'b': friction = -1"):
        Body(shape, name="b", friction=-1)
    with pytest.raises(ValueError, match=r"body 'b': limbs\[0\] = str: expected a Limb"):
        Body(shape, name="b", limbs=("arm",))  # type: ignore[arg-type]


def test_faces_end_up_counter_clockwise_seen_from_outside() -> None:
    shape = _figure()
    x, faces = np.array(shape.vertices), np.array(shape.faces)
    inward = Body((x, faces[:, ::-1]))
    assert _volume(inward) == pytest.approx(shape.volume)
    assert inward.notes == ("body: 1 of 1 parts faced inwards and were turned over",)
    again = dataclasses.replace(inward, friction=0.0)
    assert again.notes == inward.notes
    mixed = faces.copy()
    chosen = np.random.default_rng(0).choice(len(faces), 40, replace=False)
    mixed[chosen] = mixed[chosen][:, ::-1]
    repaired = Body((x, mixed))
    assert _volume(repaired) == pytest.approx(shape.volume)
    assert repaired.notes == ("body: 40 of 320 triangles ran against their neighbours and were turned over",)
    assert trimesh.Trimesh(x, repaired.mesh.faces, process=False).is_winding_consistent
    two = Body((np.concatenate([x, x + np.array([2.0, 0.0, 0.0])]), np.concatenate([faces, faces[:, ::-1] + len(x)])))
    assert _volume(two) == pytest.approx(2 * shape.volume)
    assert two.notes == ("body: 1 of 2 parts faced inwards and were turned over",)
    far = Body((x + np.array([1000.0, 0.0, 0.0]), faces[:, ::-1]))  # far from the origin too
    assert _volume(far) == pytest.approx(shape.volume)


def test_what_is_wrong_with_a_surface_is_noted() -> None:
    shape = _figure()
    x, faces = np.array(shape.vertices), np.array(shape.faces)
    opened = Body((x, faces[1:]))
    assert opened.notes == ("body: not closed, 3 open edges: distances near the holes have no reliable sign",)
    sheet = grid(1.0, 1.0, 2, 2)
    flat = Body(sheet)
    assert np.array_equal(flat.mesh.faces, sheet.faces)  # neither inside nor outside: as it was
    needle = Body((np.concatenate([x, [0.5 * (x[faces[0, 0]] + x[faces[0, 1]])]]), np.concatenate(
        [faces, [[faces[0, 0], faces[0, 1], len(x)]]])))  # fmt: skip
    assert any("1 of 321 triangles have no area" in note for note in needle.notes)
    assert any("1 edges with more than two triangles" in note for note in needle.notes)
    u, v = np.meshgrid(np.arange(12), np.arange(2), indexing="ij")
    angle, side = 2 * np.pi * u / 12, 0.2 * (v - 0.5)
    ring = np.stack([(1 + side * np.cos(angle / 2)) * np.cos(angle), side * np.sin(angle / 2),
                     (1 + side * np.cos(angle / 2)) * np.sin(angle)], axis=-1).reshape(-1, 3)  # fmt: skip
    strip = []
    for n in range(12):
        a, b = 2 * n, 2 * n + 1
        c, d = (2 * n + 2, 2 * n + 3) if n < 11 else (1, 0)
        strip += [[a, b, c], [b, d, c]]
    assert any("cannot be told apart" in note for note in Body((ring, strip)).notes)


def test_bodies_of_the_package() -> None:
    posed = body.load("female", "walk:0.25")
    skinned = rig.load("female")
    assert posed.name == "female"
    assert np.array_equal(posed.mesh.vertices, skinned.posed("walk:0.25"))
    assert np.array_equal(posed.mesh.faces, skinned.faces)
    assert np.array_equal(posed.limbs[1].points, skinned.limbs("walk:0.25")[1].points)
    assert posed.notes == ()
    by_name = Body("male")
    assert len(by_name.limbs) == 5
    assert np.array_equal(by_name.mesh.vertices, rig.load("male").vertices)
    with pytest.raises(ValueError, match="pose = 'x': expected one of"):
        body.load("female", "x")
    with pytest.raises(ValueError, match="body 'female': unit = 'cm'"):
        body.load("female", unit="cm")
    with pytest.raises(ValueError, match="unit = 'parsec': expected one of m"):
        body.load("female", unit="parsec")
    with pytest.raises(ValueError, match="up = 'x': expected one of y, z"):
        body.load("female", up="x")


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "glb", "off"])
def test_files_of_every_format_come_back_closed(tmp_path: Path, ending: str) -> None:
    shape = _figure()
    path = tmp_path / f"figure.{ending}"
    shape.export(path)
    loaded = body.load(path)
    mesh = trimesh.Trimesh(loaded.mesh.vertices, loaded.mesh.faces, process=False)
    assert mesh.is_watertight
    assert loaded.mesh.vertices.shape == (162, 3)
    assert mesh.volume == pytest.approx(shape.volume, rel=1e-5)
    assert np.allclose(mesh.bounds, shape.bounds, atol=1e-6)
    assert loaded.name == "figure"
    assert loaded.notes == ()
    assert body.load(str(path), name="doll").name == "doll"


def test_an_obj_with_texture_seams_comes_back_closed(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.5, 1.6, 0.5))
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(box.vertices).tolist()]
    lines += ["mtllib none.mtl", *(f"vt {n / 40} {(n * 7 % 36) / 36}" for n in range(36)), "usemtl skin"]
    lines += ["f " + " ".join(f"{v + 1}/{3 * n + k + 1}" for k, v in enumerate(f)) for n, f in enumerate(box.faces)]
    path = tmp_path / "box.obj"
    path.write_text("\n".join(lines))
    assert len(trimesh.load_mesh(path, process=False).vertices) > 8  # what the merge is for
    loaded = body.load(path)
    assert loaded.mesh.vertices.shape == (8, 3)
    assert loaded.notes == ()


def test_parts_of_a_file_are_one_surface_each_facing_outwards(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    inside_out = _figure()
    inside_out.invert()
    move = np.eye(4)
    move[0, 3] = 1.5
    scene.add_geometry(_figure())
    scene.add_geometry(inside_out, transform=move)
    path = tmp_path / "pair.glb"
    scene.export(path)
    loaded = body.load(path)
    assert loaded.mesh.vertices.shape == (324, 3)
    assert np.ptp(loaded.mesh.vertices[:, 0]) == pytest.approx(2.1, abs=1e-5)
    assert _volume(loaded) == pytest.approx(2 * _figure().volume, rel=1e-5)
    assert loaded.notes == ("pair: 1 of 2 parts faced inwards and were turned over",)


@pytest.mark.parametrize(("scale", "unit", "word"), [(100.0, "cm", "centimetres"), (1000.0, "mm", "millimetres")])
def test_units_are_recognised_and_said(tmp_path: Path, scale: float, unit: str, word: str) -> None:
    shape = _figure()
    shape.vertices = shape.vertices * scale
    path = tmp_path / "figure.ply"
    shape.export(path)
    loaded = body.load(path)
    assert np.ptp(loaded.mesh.vertices[:, 1]) == pytest.approx(1.6, abs=1e-4)
    assert loaded.notes == (f"figure.ply: {1.6 * scale:g} units high, read as {word} (unit='m' to override)",)
    assert body.load(path, unit=unit).notes == ()
    assert np.ptp(body.load(path, unit="m").mesh.vertices[:, 1]) == pytest.approx(1.6 * scale, rel=1e-4)
    assert np.ptp(body.load(path, unit="in").mesh.vertices[:, 1]) == pytest.approx(0.0254 * 1.6 * scale, rel=1e-4)


def test_the_axis_that_points_up(tmp_path: Path) -> None:
    shape = _figure()
    standing = trimesh.Trimesh(shape.vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0), shape.faces, process=False)
    path = tmp_path / "z.stl"
    standing.export(path)
    loaded = body.load(path)
    assert np.allclose(np.ptp(loaded.mesh.vertices, axis=0), np.ptp(shape.vertices, axis=0), atol=1e-6)
    assert loaded.mesh.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert loaded.mesh.vertices[:, 2].max() == pytest.approx(0.17, abs=1e-6)  # the front stays in front
    assert loaded.notes == ("z.stl: 1.6 long along z, 0.3 along y: read with z up (up='y' to override)",)
    assert body.load(path, up="z").notes == ()
    assert np.ptp(body.load(path, up="y").mesh.vertices[:, 2]) == pytest.approx(1.6, abs=1e-6)
    table = trimesh.creation.box((0.8, 0.7, 2.0))
    table.apply_translation((0.0, 0.35, 0.0))
    table.export(tmp_path / "table.ply")
    lying = body.load(tmp_path / "table.ply")  # long, but it does not stand on z = 0
    assert np.ptp(lying.mesh.vertices[:, 1]) == pytest.approx(0.7, abs=1e-6)
    assert "read with y up (up='z' to override)" in lying.notes[0]


def test_bad_files_are_refused_in_one_line(tmp_path: Path) -> None:
    def refuse(name: str, content: bytes, message: str) -> None:
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=message) as caught:
            body.load(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)

    refuse("a.obj", b"v 0 0 0\nv 1 0 0\n", "cannot be read as obj|holds no triangle")
    refuse("b.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "1 given; a body needs at least four")
    nan = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 nan\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    refuse("c.obj", nan, r"vertices\[3, 2\] is nan")
    refuse("d.stl", b"\x00" * 40, "cannot be read as stl|holds no triangle")
    refuse("e.pkl", b"cos\nsystem\n(S'true'\ntR.", r"cannot read '\.pkl': expected .*glb")
    refuse("f.zip", b"PK", r"cannot read '\.zip'")
    refuse("g", b"", "cannot read 'a file without ending'")
    refuse("h.ply", b"ply\nformat ascii 1.0\n", "cannot be read as ply|holds no triangle")
    with pytest.raises(ValueError, match=r"nobody\.obj: no such file, and no body of the package"):
        body.load(tmp_path / "nobody.obj")
    _figure().export(tmp_path / "figure.ply")
    with pytest.raises(ValueError, match=r"figure\.ply: pose = 'a_pose': a mesh file has no skeleton"):
        body.load(tmp_path / "figure.ply", pose="a_pose")
