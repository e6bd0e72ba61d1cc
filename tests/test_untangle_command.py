"""`clothgym untangle`: files of every kind, what is kept of them, and strategies of a user."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_cases import crossing, write_obj

import clothgym as cg
from clothgym import cli
from clothgym.commands.untangle import read_fixed, read_mesh


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "off", "glb"])
def test_untangle_resolves_a_file_of_every_kind(say, commands: Path, ending: str) -> None:
    vertices, faces = crossing()
    source = commands / f"in.{ending}"
    trimesh.Trimesh(vertices, faces, process=False).export(source)
    said = say("untangle", str(source), f"out.{ending}", "--json")
    document = said.document
    assert said.code == 0
    assert document["hits_before"] == 14
    assert document["hits_after"] == 0
    assert document["resolved"] is True
    assert document["length_before"] == pytest.approx(cg.intersections(vertices, faces).length, rel=1e-5)
    assert document["passes"] >= 1
    before, after = (trimesh.load_mesh(commands / f"{name}.{ending}", process=False) for name in ("in", "out"))
    assert np.array_equal(before.faces, after.faces)
    assert 0.0 < np.abs(before.vertices - after.vertices).max() < 0.4


def test_untangle_keeps_everything_else_of_an_obj(say, commands: Path) -> None:
    vertices, faces = crossing()
    source = write_obj(commands / "in.obj", vertices, faces)
    (commands / "fixed.txt").write_text("# the whole first sheet\n" + "\n".join(map(str, range(25))))
    assert say("untangle", "in.obj", "out.obj", "--fixed", "fixed.txt").code == 0
    old, new = source.read_text().splitlines(), (commands / "out.obj").read_text().splitlines()
    assert [line for line in old if not line.startswith("v ")] == [line for line in new if not line.startswith("v ")]
    changed = [index for index, (a, b) in enumerate(zip(old, new)) if a != b]
    assert changed
    moved, _, _ = read_mesh(commands / "out.obj", None)
    assert np.array_equal(moved[:25], vertices[:25])
    assert np.array_equal(moved[50], [9.0, 9.0, 9.0])
    assert cg.intersections(moved, faces).length == 0.0


def test_vertices_at_one_place_move_as_one(say, commands: Path) -> None:
    vertices, faces = crossing()
    split, split_faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    trimesh.Trimesh(split, split_faces, process=False).export(commands / "split.ply")
    said = say("untangle", "split.ply", "out.ply", "--json")
    assert said.code == 0
    assert said.err == "split.ply: 142 of 192 vertices lie exactly on another: moved as one\n"
    after = trimesh.load_mesh(commands / "out.ply", process=False)
    assert len(after.vertices) == 192
    assert len(np.unique(np.asarray(after.vertices), axis=0)) == 50
    apart = say("untangle", "split.ply", "apart.ply", "--no-weld", "--passes", "1", "--json")
    assert apart.err == ""
    loose = trimesh.load_mesh(commands / "apart.ply", process=False)
    assert len(np.unique(np.asarray(loose.vertices), axis=0)) > 50


def test_untangle_says_when_it_is_not_done(say, commands: Path) -> None:
    write_obj(commands / "in.obj", *crossing())
    said = say("untangle", "in.obj", "out.obj", "--passes", "1")
    assert said.code == cli.FAILED
    assert re.search(r"resolved +no", said.out)
    assert (commands / "out.obj").exists()


def test_untangle_onto_itself_never_loses_the_input(say, commands: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = write_obj(commands / "in.obj", *crossing())
    before = source.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device", "in.obj")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        said = say("untangle", "in.obj", "in.obj")
    assert said.code == cli.FAILED
    assert "no space left on device" in said.err
    assert source.read_bytes() == before
    assert sorted(path.name for path in commands.iterdir()) == ["in.obj"]
    assert say("untangle", "in.obj", "in.obj").code == 0
    assert source.read_bytes() != before
    assert say("untangle", "in.obj", "in.obj", "--json").document["hits_before"] == 0


def test_fixed_files_of_every_kind(tmp_path: Path) -> None:
    wanted = np.zeros(5, dtype=bool)
    wanted[[1, 3]] = True
    np.save(tmp_path / "mask.npy", wanted)
    np.save(tmp_path / "ids.npy", np.array([3, 1, 1]))
    (tmp_path / "ids.json").write_text("[1, 3]")
    (tmp_path / "mask.json").write_text("[false, true, false, true, false]")
    (tmp_path / "ids.txt").write_text("1,3\n# 4\n")
    for name in ("mask.npy", "ids.npy", "ids.json", "mask.json", "ids.txt"):
        assert np.array_equal(read_fixed(tmp_path / name, 5), wanted), name
    np.save(tmp_path / "floats.npy", np.zeros(5))
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    (tmp_path / "torn.npy").write_bytes((tmp_path / "mask.npy").read_bytes()[:40])
    (tmp_path / "short.json").write_text("[true, false]")
    (tmp_path / "mixed.json").write_text("[1, true]")
    (tmp_path / "dict.json").write_text('{"fixed": [1]}')
    (tmp_path / "negative.txt").write_text("-1")
    (tmp_path / "words.txt").write_text("1 two")
    for name, complaint in (
        ("floats.npy", "expected ids or booleans, got float64"),
        ("objects.npy", "not a .npy array"),
        ("torn.npy", "not a .npy array"),
        ("short.json", "2 booleans, but the mesh has 5 vertices"),
        ("mixed.json", "entry 1 = True"),
        ("dict.json", "expected a list"),
        ("negative.txt", "entry 0 = -1"),
        ("words.txt", "entry 1 = 'two'"),
    ):
        with pytest.raises(ValueError, match=re.escape(f"{name}: ") + ".*" + re.escape(complaint)):
            read_fixed(tmp_path / name, 5)


def test_a_users_own_strategy_is_found_beside_him(say, commands: Path) -> None:
    (commands / "my_strategy_module.py").write_text(
        "from clothgym.response.untangling.hybrid import Hybrid\n\n\nclass Mine(Hybrid):\n    pass\n"
    )
    write_obj(commands / "in.obj", *crossing())
    said = say("untangle", "in.obj", "out.obj", "--strategy", "my_strategy_module:Mine", "--json")
    assert said.code == 0, said.err
    assert said.document["strategy"] == "my_strategy_module:Mine"
