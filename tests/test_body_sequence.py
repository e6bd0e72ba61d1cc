"""Bodies that move as files say: what is read, decided, and refused in one line."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import trimesh

from clothgym import body, body_sequence, rig
from clothgym.dressing import drape, play
from clothgym.dressing.worn import carried_limbs
from clothgym.motion import Keyframes, Walk


def figure():
    """A barrel on the ground, 1.2 m tall, that leans and turns."""
    mesh = trimesh.creation.capsule(0.9, 0.15, count=[12, 12])
    mesh.vertices = mesh.vertices[:, [1, 2, 0]] + [0.0, 0.15 - mesh.bounds[0, 2] - 0.15, 0.0]
    return mesh


def moving(count=5):
    mesh = figure()
    v = np.asarray(mesh.vertices)
    shapes = np.stack([v + np.outer(v[:, 1], [0.02 * n, 0.0, 0.0]) for n in range(count)])
    return shapes, np.asarray(mesh.faces)


def write_folder(path: Path, shapes, faces, ending="obj"):
    path.mkdir()
    for n, shape in enumerate(shapes):
        trimesh.Trimesh(shape, faces, process=False).export(path / f"frame_{n}.{ending}")
    (path / "notes.txt").write_text("not a mesh")
    return path


def test_the_three_ways_agree(tmp_path):
    shapes, faces = moving(12)
    np.savez(tmp_path / "a.npz", vertices=shapes, faces=faces, rate=60.0)
    folder = write_folder(tmp_path / "frames", shapes, faces)
    np.save(tmp_path / "ways.npy", shapes)
    found = [
        body.load(tmp_path / "a.npz"),
        body_sequence.load(folder, rate=60.0),
        body_sequence.load(folder / "frame_0.obj", tmp_path / "ways.npy", rate=60.0),
        body_sequence.load(folder / "frame_0.obj", folder, rate=60.0),
    ]
    for one in found:
        assert one.motion.times == pytest.approx(np.arange(12) / 60.0)
        # frame_10 comes after frame_9, not after frame_1
        for n in (0, 2, 10, 11):
            lean = one.at(n / 60.0)
            expected = shapes[n]
            assert np.sort(lean[:, 0]) == pytest.approx(np.sort(expected[:, 0]), abs=1e-6)
        assert one.at(0.5 / 60.0)[:, 0].max() == pytest.approx(0.5 * (shapes[0] + shapes[1])[:, 0].max(), abs=1e-6)
        assert any("12 frames in 0.183 s" in note for note in one.notes)


def test_texture_seams_do_not_multiply_vertices(tmp_path):
    shapes, faces = moving(3)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in shapes[0].tolist()]
    lines += [f"vt {n / len(faces)} 0.5" for n in range(3 * len(faces))]
    lines += ["f " + " ".join(f"{v + 1}/{3 * n + k + 1}" for k, v in enumerate(f)) for n, f in enumerate(faces)]
    (tmp_path / "skin.obj").write_text("\n".join(lines))
    np.save(tmp_path / "ways.npy", shapes)
    found = body_sequence.load(tmp_path / "skin.obj", tmp_path / "ways.npy")
    assert found.mesh.vertices.shape == shapes[0].shape
    assert found.at(2 / 30.0) == pytest.approx(shapes[2])


def test_vertices_that_part_later_stay_two(tmp_path):
    """Two boxes that touch at a corner in the first frame only."""
    box = trimesh.creation.box((0.5, 1.0, 0.5))
    v, f = np.asarray(box.vertices), np.asarray(box.faces)
    both = np.concatenate([v, v + np.array([0.5, 1.0, 0.5])])
    later = np.concatenate([v, v + np.array([0.7, 1.0, 0.5])])
    np.savez(tmp_path / "a.npz", vertices=[both, later], faces=np.concatenate([f, f + 8]))
    assert len(body.load(tmp_path / "a.npz").mesh.vertices) == 16


def test_unit_and_axis_hold_for_all_frames(tmp_path):
    shapes, faces = moving()
    turned = 100.0 * shapes[..., [0, 2, 1]] * [1.0, -1.0, 1.0]
    np.savez(tmp_path / "a.npz", vertices=turned, faces=faces, times=np.arange(5) + 3.0)
    for asked in ({}, {"unit": "cm", "up": "z"}):
        found = body.load(tmp_path / "a.npz", **asked)
        for n in range(5):
            assert found.at(float(n)) == pytest.approx(shapes[n], abs=1e-9), "times begin at 0"
        assert bool([note for note in found.notes if "centimetres" in note]) == (asked == {})
    assert np.ptp(body.load(tmp_path / "a.npz", unit="mm", up="z").at(4.0)[:, 1]) == pytest.approx(0.12, rel=1e-3)


def spoiled(tmp_path: Path, how: str) -> tuple[Path, Path | None]:
    shapes, faces = moving(3)
    path = tmp_path / "a.npz"
    mesh = tmp_path / "skin.ply"
    trimesh.Trimesh(shapes[0], faces, process=False).export(mesh)
    if how == "no faces":
        np.savez(path, vertices=shapes)
    elif how == "other faces":
        np.savez(path, vertices=shapes, faces=faces + len(shapes[0]))
    elif how == "one frame":
        np.savez(path, vertices=shapes[:1], faces=faces)
    elif how == "flat":
        np.savez(path, vertices=shapes[0], faces=faces)
    elif how == "words":
        np.savez(path, vertices=np.array([["a"]]), faces=faces)
    elif how == "objects":
        np.savez(path, vertices=np.array([None, {}], dtype=object), faces=faces)
    elif how == "not finite":
        shapes[2, 5, 1] = np.nan
        np.savez(path, vertices=shapes, faces=faces)
    elif how == "times":
        np.savez(path, vertices=shapes, faces=faces, times=[0.0, 1.0, 1.0])
    elif how == "few times":
        np.savez(path, vertices=shapes, faces=faces, times=[0.0, 1.0])
    elif how == "broken":
        path.write_bytes(b"PK\x03\x04 no archive")
    elif how == "empty folder":
        path = tmp_path / "empty"
        path.mkdir()
    elif how == "other mesh in the folder":
        path = write_folder(tmp_path / "frames", shapes, faces)
        figure().subdivide().export(path / "frame_7.obj")
    elif how == "npy alone":
        path = tmp_path / "a.npy"
        np.save(path, shapes)
    elif how == "other count":
        np.save(tmp_path / "a.npy", shapes[:, :-1])
        return mesh, tmp_path / "a.npy"
    elif how == "frames of text":
        (tmp_path / "a.csv").write_text("1,2,3")
        return mesh, tmp_path / "a.csv"
    elif how == "no frames file":
        return mesh, tmp_path / "none.npy"
    return path, None


@pytest.mark.parametrize(
    ("how", "told"),
    [
        ("no faces", r"a\.npz: no array 'faces' \(it has vertices\)"),
        ("other faces", r"a\.npz: .*faces"),
        ("one frame", r"a\.npz: one frame; a sequence needs two or more"),
        ("flat", r"a\.npz: vertices: expected \(frames, vertices, 3\) numbers, got float64"),
        ("words", r"a\.npz: vertices: expected \(frames, vertices, 3\) numbers, got <U1"),
        ("objects", r"a\.npz: cannot be read as arrays: .*pickle"),
        ("not finite", r"a\.npz: frame 2 is not finite"),
        ("times", r"a\.npz: keyframes\.times: expected two or more finite times that rise"),
        ("few times", r"a\.npz: times: expected \(3,\), got \(2,\)"),
        ("broken", r"a\.npz: cannot be read as arrays"),
        ("empty folder", r"empty: 0 mesh files; a sequence needs two or more"),
        ("other mesh in the folder", r"frame_7\.obj: not the vertices and triangles of frame_0\.obj"),
        ("npy alone", r"a\.npy: holds vertices only"),
        ("other count", r"a\.npy: \d+ vertices a frame, but .*skin\.ply has \d+"),
        ("frames of text", r"a\.csv: expected frames as \.npy, \.npz or a folder"),
        ("no frames file", r"none\.npy: no such file"),
    ],
)
def test_wrong_sequences_get_one_line(tmp_path, how, told):
    source, frames = spoiled(tmp_path, how)
    with pytest.raises(ValueError, match=told) as caught:
        body_sequence.load(source, frames)
    assert "\n" not in str(caught.value)


def test_a_skirt_goes_along_with_a_body_that_moves(tmp_path):
    """Dressed on the first shape, then moved: it stays on and does not sink in."""
    skin = rig.load("female")
    start, steps = skin.posed("a_pose"), Walk("female", "a_pose")
    shapes = np.stack([steps.vertices(start, time) for time in (0.0, 0.1, 0.2, 0.3)])
    np.savez(tmp_path / "a.npz", vertices=shapes, faces=skin.faces, rate=10.0)
    loaded = body.load(tmp_path / "a.npz")
    standing = dataclasses.replace(loaded, motion=None)
    draped = drape("skirt", standing, edge_length=0.04, fidelity="draft", self_collision=False, seconds=0.5)
    played = play(draped, loaded.motion, 0.2)
    assert draped.report["worn"] and played.report["worn"]
    assert played.report["depth_max"] < 3e-3
    assert len(played.frames) == 12
    assert np.abs(played.simulation.body_meshes[0][1] - loaded.at(0.2)).max() < 1e-12


@pytest.mark.parametrize("time", [0.0, 0.9, 1.3, 1.7])
def test_limbs_go_along_with_the_surface(time):
    """As the skeleton has them, from the vertices alone."""
    woman, steps = body.load("female", "a_pose"), Walk("female", "a_pose")
    carried = carried_limbs(woman, steps.vertices(woman.mesh.vertices, time))
    for limb, true in zip(carried, rig.load("female").limbs(steps.rotations(time)), strict=True):
        assert (limb.name, limb.start) == (true.name, true.start)
        off = np.linalg.norm(limb.points - true.points, axis=1)
        assert off.max() < 0.01


def test_play_tells_whether_a_body_with_limbs_still_wears_it():
    woman = body.load("female", "a_pose")
    start, low = woman.mesh.vertices, np.array([0.0, -1.0, 0.0])
    draped = drape("skirt", woman, edge_length=0.04, fidelity="draft", self_collision=False, seconds=0.5)
    moved = np.stack([start, start + 0.02 * low])
    assert play(draped, Keyframes((0.0, 0.1), moved), 0.1).report["worn"] is True
    gone = np.stack([start, start + 3.0 * low])
    assert play(draped, Keyframes((0.0, 0.02), gone), 0.1).report["worn"] is False
