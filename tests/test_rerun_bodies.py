"""Rerun recordings of bodies: written once while they stand still, and replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from rerun_cases import write

from clothgym.recording.rerun_log import RerunLog
from clothgym.recording.rerun_read import read_recording

pytest.importorskip("rerun")


def block(size: float = 0.2, height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A closed box."""
    x = size * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float) + (0.0, height, 0.0)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return x, np.array([f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))], np.int32)


def on_blocks() -> Any:
    """A sheet that falls onto two boxes of one name."""
    import clothgym as cg
    from clothgym.body import Body

    flat = cg.grid(0.5, 0.5, 4, 4)
    cloth = cg.Cloth((np.asarray(flat.vertices) + np.array([0.0, 0.25, 0.0]), flat.faces))
    return cg.Scene((cloth,), bodies=(Body(block(), "block/1"), Body(block(0.1, 0.11), "block/1")), ground=-0.2)


def test_bodies_that_stand_still_are_written_once(tmp_path: Path) -> None:
    """Faces, vertices and normals, static, under world/bodies; read back at every step; checksummed."""
    from rerun.chunk import RrdReader

    import clothgym as cg

    simulation = cg.Simulation(on_blocks(), fidelity="draft")
    with RerunLog(tmp_path / "blocks.rrd", batch_steps=2) as log:
        log.open_simulation(simulation)
        for k in range(6):
            log.log_simulation(k, simulation)
            simulation.step()
    found = read_recording(tmp_path / "blocks.rrd")
    assert list(found.bodies) == ["block/1", "block/1 2"]
    for track, (vertices, faces) in zip(found.bodies.values(), (block(), block(0.1, 0.11))):
        assert np.array_equal(track.faces, faces)
        assert track.positions.shape == (1, 8, 3)
        for step in (0, 5):
            assert np.array_equal(track.at(step), vertices.astype(np.float32))
        outwards = vertices - vertices.mean(axis=0)
        assert (
            np.einsum("vi,vi->v", track.normals[0], outwards / np.linalg.norm(outwards, axis=1)[:, None]) > 0.8
        ).all()
    chunks = [c for c in RrdReader(tmp_path / "blocks.rrd").stream() if str(c.entity_path).startswith("/world/bodies/")]
    assert len(chunks) == 2
    assert all(chunk.is_static for chunk in chunks)
    sums = found.documents["end"]["checksums"]
    kinds = {"triangle_indices", "vertex_positions", "vertex_normals"}
    assert {k.partition("Mesh3D:")[2] for k in sums if k.startswith("/world/bodies/")} == kinds


def test_bodies_still_and_moving_need_names_of_their_own(tmp_path: Path) -> None:
    with RerunLog(tmp_path / "a.rrd") as log:
        with pytest.raises(ValueError, match=r"names must differ.*'block'"):
            log.open([("a", [[0, 1, 2]], None)], [("block", *block())], still_bodies=[("block", *block())])
        log.open([("a", [[0, 1, 2]], None)], [("moves", *block())], still_bodies=[("stays", *block())])
        log.log_step(4, 0.0, np.eye(3), bodies={"moves": block()[0] + 1.0})
        with pytest.raises(ValueError, match="stays"):
            log.log_step(5, 0.1, np.eye(3), bodies={"stays": block()[0]})
    found = read_recording(tmp_path / "a.rrd")
    assert np.array_equal(found.bodies["moves"].at(4), (block()[0] + 1.0).astype(np.float32))
    assert np.array_equal(found.bodies["stays"].at(4), block()[0].astype(np.float32))


def test_files_from_before_still_bodies_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their scene document has no such list."""
    log_document = RerunLog.log_document

    def older(self: RerunLog, name: str, document: dict[str, Any]) -> None:
        log_document(self, name, {k: v for k, v in document.items() if k != "still_bodies"})

    monkeypatch.setattr(RerunLog, "log_document", older)
    logged = write(tmp_path / "older.rrd", steps=5)
    found = read_recording(tmp_path / "older.rrd")
    assert "still_bodies" not in found.documents["scene"]
    assert list(found.bodies) == ["still", "moving"]
    assert np.array_equal(found.bodies["moving"].at(4), logged[4]["moving"].astype(np.float32))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "body 'block' has no Mesh3D:triangle_indices"),
        ({"triangle_indices": [[0, 1, 2]]}, "body 'block' has no Mesh3D:vertex_positions"),
        ({"triangle_indices": [[0, 1, 2]], "vertex_positions": np.eye(3)}, "body 'block' has no Mesh3D:vertex_normals"),
        (
            {"triangle_indices": [[0, 1, 2]], "vertex_positions": np.eye(3), "vertex_normals": np.eye(3)[:2]},
            "changes its number of vertices",
        ),
        (
            {"triangle_indices": [[0, 1, 3]], "vertex_positions": np.eye(3), "vertex_normals": np.eye(3)},
            "faces beyond its 3 vertices",
        ),
        ("moves", "body 'block' has steps"),
        ("twice", "body 'block' is there twice"),
    ],
)
def test_still_bodies_that_do_not_fit_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fields: Any, message: str
) -> None:
    """A file whose scene document names a body that is not there as such."""
    import rerun as rr

    log_document = RerunLog.log_document

    def naming(self: RerunLog, name: str, document: dict[str, Any]) -> None:
        log_document(self, name, {**document, "still_bodies": [{"name": "block"}]} if name == "scene" else document)

    monkeypatch.setattr(RerunLog, "log_document", naming)
    eye = np.eye(3, dtype=np.float32)
    with RerunLog(tmp_path / "wrong.rrd") as log:
        if fields == "twice":
            log.open([("a", [[0, 1, 2]], None)], [("block", *block())])
            fields = {"triangle_indices": [[0, 1, 2]], "vertex_positions": eye, "vertex_normals": eye}
        else:
            log.open([("a", [[0, 1, 2]], None)])
        if fields == "moves":
            log._writer.mesh("world/bodies/block", np.array([[0, 1, 2]], np.int32), (1, 2, 3))
            log._writer.send("world/bodies/block", [(0, 0, {"positions": eye, "normals": eye})])
        elif fields:
            log._writer.static("world/bodies/block", rr.Mesh3D.from_fields(**fields))
        log.log_step(0, 0.0, eye)
    with pytest.raises(ValueError, match=rf"wrong\.rrd: .*{message}"):
        read_recording(tmp_path / "wrong.rrd")


class OnBlocks(gym.Env[np.ndarray, np.ndarray]):
    """A sheet on boxes; the action blows it about."""

    observation_space = gym.spaces.Box(-10, 10, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        import clothgym as cg

        super().reset(seed=seed)
        self.episode_seed = int(self.np_random.integers(10_000)) if seed is None else seed
        self.simulation = cg.Simulation(on_blocks(), fidelity="draft")
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.simulation.set_velocities(self.simulation.velocities + 0.3 * np.asarray(action, float))
        self.simulation.step(3)
        depth = self.simulation.penetration_depth()
        return self._seen(), -depth, False, False, {"penetration_depth": depth}

    def _seen(self) -> np.ndarray:
        return self.simulation.positions[0].astype(np.float32)


def test_an_episode_with_bodies_is_replayed_bit_for_bit(tmp_path: Path) -> None:
    from clothgym_envs.recorder import RerunRecorder, read_episode, replay

    gym.register("clothgym/OnBlocks-v7", entry_point=OnBlocks, max_episode_steps=8)
    try:
        env = RerunRecorder(gym.make("clothgym/OnBlocks-v7", disable_env_checker=True), tmp_path / "blocks.rrd")
        rng = np.random.default_rng(0)
        env.reset(seed=3)
        for _ in range(8):
            env.step(rng.uniform(-1, 1, 3).astype(np.float32))
        touched = float(np.abs(env.unwrapped.simulation.body_forces).max())
        env.close()
        episode, recording = read_episode(tmp_path / "blocks.rrd")
        assert touched > 0.0, "the cloth lies on the boxes"
        assert list(recording.bodies) == ["block/1", "block/1 2"]
        assert np.array_equal(recording.bodies["block/1"].at(8), block()[0].astype(np.float32))
        again = replay(episode, recording.positions(len(episode)))
        assert (again["equal"], again["steps"], again["first_difference"]) == (True, 8, None)
    finally:
        gym.registry.pop("clothgym/OnBlocks-v7")
