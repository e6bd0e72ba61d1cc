"""Rerun recordings: what was logged is read back exactly, a kill loses little, damaged files are refused."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rerun_cases import STEPS, sheet, write

from clothgym.recording.rerun_log import RerunLog
from clothgym.recording.rerun_read import read_recording

pytest.importorskip("rerun")


def rerun_cli(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Not `python -m rerun_cli`, which drops the exit code."""
    command = [sys.executable, "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    path = tmp_path_factory.mktemp("rrd") / "everything.rrd"
    return path, write(path)


def test_everything_is_read_back_exactly(written: tuple[Path, list[dict[str, Any]]]) -> None:
    path, logged = written
    found = read_recording(path)
    assert found.complete
    assert found.has_blueprint
    assert found.application == "clothgym"
    assert found.ground == -0.5
    assert found.documents["episode"] == {"note": "größer", "numbers": [1, 2.5, None]}
    assert found.steps.tolist() == list(range(STEPS))
    np.testing.assert_allclose(found.sim_time, [row["time"] for row in logged], atol=1e-9)
    assert list(found.cloths) == ["lower sheet", "up/per (2)"]
    assert np.array_equal(found.cloths["up/per (2)"].faces, sheet(7)[1])
    for k, row in enumerate(logged):
        assert np.array_equal(found.positions(k), row["positions"].astype(np.float32))
        assert np.array_equal(found.contours[k][0], row["segments"].astype(np.float32))
        assert np.array_equal(found.contours[k][1], row["contour"])
        assert np.array_equal(found.hits[k], row["hits"].astype(np.float32))
        assert np.array_equal(found.points["grippers"][k], row["grippers"].astype(np.float32))
        assert np.array_equal(found.bodies["moving"].at(k), row["moving"].astype(np.float32))
    assert np.array_equal(found.bodies["still"].positions, [(sheet(6)[0] * 0.2).astype(np.float32)])
    assert len(found.bodies["moving"].steps) == STEPS // 4, "a body is logged when it moved, not at every step"
    steps, values = found.scalars["reward/depth"]
    assert steps.tolist() == list(range(STEPS))
    assert values.tolist() == [row["scalars"]["reward/depth"] for row in logged]
    assert found.scalars["only sometimes"][0].tolist() == list(range(1, STEPS, 2))
    assert found.action_steps.tolist() == list(range(1, STEPS))
    assert found.actions.dtype == np.float32
    assert found.actions.tobytes() == np.stack([row["action"] for row in logged[1:]]).tobytes()
    assert found.outcomes["state_hash"] == [row["hash"] for row in logged]
    assert found.outcomes["reward"] == [row["reward"] for row in logged]
    assert found.outcomes["truncated"] == [False] * (STEPS - 1) + [True]


def test_normals_are_there_at_every_step_and_right(written: tuple[Path, list[dict[str, Any]]]) -> None:
    track = read_recording(written[0]).cloths["lower sheet"]
    corners = track.positions[-1][track.faces].astype(np.float64)
    area_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    expected = np.zeros((track.positions.shape[1], 3))
    for corner in range(3):
        np.add.at(expected, track.faces[:, corner], area_normals)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert track.normals.shape == track.positions.shape
    np.testing.assert_allclose(track.normals[-1], expected, atol=1e-5)


def test_reruns_own_verifier_accepts_the_file(written: tuple[Path, list[dict[str, Any]]]) -> None:
    ended = rerun_cli("rrd", "verify", str(written[0]))
    assert ended.returncode == 0, ended.stderr
    assert "1 file verified without error" in ended.stdout + ended.stderr


def test_faces_are_written_once_and_a_step_costs_its_positions(tmp_path: Path) -> None:
    """Static data is in one chunk per mesh; what a step adds is little more than positions and normals."""
    from rerun.chunk import RrdReader

    sizes = {}
    for steps in (16, 144):
        path = tmp_path / f"{steps}.rrd"
        write(path, steps, n=30)
        sizes[steps] = path.stat().st_size
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if "Mesh3D:triangle_indices" in batch.schema.names:
            assert chunk.is_static
            rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + batch.num_rows
    assert set(rows.values()) == {1}
    assert len(rows) == 5, rows
    # 24 bytes a vertex (two sheets each step, a body every fourth); 3.5 kB for points, scalars and the action's chunk
    per_step = (sizes[144] - sizes[16]) / 128
    assert per_step < 24 * (900 + 961 * 1.25) + 3500


@pytest.mark.parametrize("kept", [0.999999, 0.9, 0.75, 0.6, 0.4, 0.0005])
def test_partial_only_when_asked(tmp_path: Path, written: tuple[Path, list[dict[str, Any]]], kept: float) -> None:
    """Cut anywhere: refused, or with partial=True read up to the last whole message."""
    path = tmp_path / "cut.rrd"
    data = written[0].read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(ValueError, match=r"cut\.rrd: ") as refusal:
        read_recording(path)
    assert "\n" not in str(refusal.value)
    if kept < 0.001:  # not even the names of the meshes are whole
        with pytest.raises(ValueError, match=r"cut\.rrd: "):
            read_recording(path, partial=True)
        return
    found = read_recording(path, partial=True)
    assert len(found.steps) == STEPS or kept < 0.99
    assert found.steps.tolist() == list(range(len(found.steps)))
    for k in found.steps:
        assert np.array_equal(found.positions(k), written[1][k]["positions"].astype(np.float32))


def test_a_file_that_rerun_has_optimized_is_still_read(
    tmp_path: Path, written: tuple[Path, list[dict[str, Any]]]
) -> None:
    path = tmp_path / "optimized.rrd"
    ended = rerun_cli("rrd", "optimize", str(written[0]), "-o", str(path))
    assert ended.returncode == 0, ended.stderr
    assert path.read_bytes() != written[0].read_bytes()
    assert np.array_equal(read_recording(path).positions(7), written[1][7]["positions"].astype(np.float32))


KILLED = """
import os, signal, sys
import numpy as np
from clothgym.recording.rerun_log import RerunLog
log = RerunLog(sys.argv[1], batch_steps=8)
log.open([("sheet", np.array([[0, 1, 2]]), None)])
for k in range(30):
    log.log_action(k + 1, k / 20, np.full(2, k, np.float32))
    log.log_step(k, k / 20, np.full((3, 3), k), outcome={"state_hash": str(k)})
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="POSIX signals")
def test_a_killed_run_keeps_every_action_and_all_but_the_last_batch(tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    ended = subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, timeout=120)
    assert ended.returncode == -signal.SIGKILL
    with pytest.raises(ValueError, match=r"killed\.rrd: cut short"):
        read_recording(path)
    found = read_recording(path, partial=True)
    assert not found.complete
    assert len(found.steps) >= 30 - 8
    assert found.steps.tolist() == list(range(len(found.steps)))
    assert found.actions.tolist() == [[k, k] for k in range(30)]
    assert np.array_equal(found.positions(20), np.full((3, 3), 20, np.float32))


UNCLOSED = """
import sys
import numpy as np
from clothgym.recording.rerun_log import RerunLog
log = RerunLog(sys.argv[1], batch_steps=1000)
log.open([("sheet", np.array([[0, 1, 2]]), None)])
for k in range(5):
    log.log_step(k, k / 20, np.full((3, 3), k))
"""


def test_a_recording_that_nobody_closed_is_finished_at_exit(tmp_path: Path) -> None:
    path = tmp_path / "unclosed.rrd"
    subprocess.run([sys.executable, "-c", UNCLOSED, str(path)], check=True, timeout=120)
    assert len(read_recording(path).steps) == 5


def test_an_error_in_the_block_finishes_the_file(tmp_path: Path) -> None:
    path = tmp_path / "error.rrd"
    with pytest.raises(ZeroDivisionError, match="by zero"), RerunLog(path) as log:  # noqa: PT012
        log.open([("sheet", [[0, 1, 2]], None)])
        log.log_step(0, 0.0, np.eye(3))
        _ = 1 / 0
    found = read_recording(path)
    assert found.steps.tolist() == [0]
    assert found.documents["end"]["failure"] == "ZeroDivisionError: division by zero"


READ_ALL = """
import sys
import numpy as np
from clothgym.recording.rerun_read import read_recording
def content(found):
    tracks = [*found.cloths.values(), *found.bodies.values()]
    arrays = [a for t in tracks for a in (t.faces, t.steps, t.positions, t.normals)]
    arrays += [found.steps, found.sim_time, found.actions, *(a for pair in found.contours.values() for a in pair)]
    arrays += [*found.hits.values(), *(a for pair in found.scalars.values() for a in pair)]
    arrays += [a for by_step in found.points.values() for a in by_step.values()]
    documents = sorted((k, v) for k, v in found.documents.items() if k != "end")
    return repr((documents, sorted(found.outcomes.items()), [a.tobytes() for a in arrays]))
expected = content(read_recording(sys.argv[1]))
for name in sys.argv[2:]:
    try:
        found = content(read_recording(name))
    except ValueError as error:
        assert str(error).startswith(name + ":") and "\\n" not in str(error), error
        print("refused")
    else:
        assert found == expected, name
        print("same")
"""


def test_a_flipped_bit_is_refused_or_harmless(tmp_path: Path) -> None:
    """In a child process, as a malformed file can end the process that rerun decodes it in."""
    original = tmp_path / "good.rrd"
    write(original, steps=4, n=3)
    data = original.read_bytes()
    rng = random.Random(11)
    names = []
    for index in range(24):
        changed = bytearray(data)
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        names.append(tmp_path / f"flip{index}.rrd")
        names[-1].write_bytes(changed)
    command = [sys.executable, "-c", READ_ALL, str(original), *map(str, names)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode == 0, ended.stderr[-2000:]
    verdicts = ended.stdout.split()
    assert len(verdicts) == len(names)
    assert verdicts.count("refused") >= len(names) // 2


def foreign_files(folder: Path) -> list[str]:
    """Files that are no recordings of this format."""
    import rerun as rr

    plain = folder / "plain.rrd"
    stream = rr.RecordingStream("someone else", recording_id="x")
    stream.save(plain)
    stream.log("points", rr.Points3D([[0, 0, 0]]))
    stream.flush()
    stream.disconnect()
    future = folder / "future.rrd"
    with RerunLog(future) as log:
        log.open([("sheet", [[0, 1, 2]], None)])
        log.log_step(0, 0.0, np.eye(3))
        log.log_document("scene", {"format": "clothgym-recording", "format_version": 99})
    (folder / "text.rrd").write_text("hello")
    (folder / "empty.rrd").write_bytes(b"")
    (folder / "noise.rrd").write_bytes(b"RRF2" + random.Random(1).randbytes(5000))
    (folder / "png.rrd").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    return ["plain", "future", "text", "empty", "noise", "png", "missing"]


def test_foreign_files_are_refused_in_one_line(tmp_path: Path) -> None:
    for name in foreign_files(tmp_path):
        for partial in (False, True):
            with pytest.raises(ValueError, match=rf"{name}\.rrd: .+") as refusal:
                read_recording(tmp_path / f"{name}.rrd", partial=partial)
            assert "\n" not in str(refusal.value)
            assert len(str(refusal.value)) < 500
    with pytest.raises(ValueError, match="no such file"):
        read_recording(tmp_path)


def open_log(path: Path) -> RerunLog:
    log = RerunLog(path)
    log.open([("sheet", [[0, 1, 2]], None)], [("ball", np.eye(3), [[0, 1, 2]])])
    log.log_step(3, 0.0, np.eye(3))
    return log


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda log: log.log_step(3, 0.1, np.eye(3)), "step = 3"),
        (lambda log: log.log_step(4, 0.1, np.zeros((4, 3))), "positions"),
        (lambda log: log.log_step(4, 0.1, np.eye(3), bodies={"table": np.eye(3)}), "table"),
        (lambda log: log.log_step(4, 0.1, np.eye(3), bodies={"ball": np.zeros((5, 3))}), "ball"),
        (lambda log: log.log_step(4, 0.1, np.eye(3), contours=(np.zeros((2, 2, 3)), [1])), "contours"),
        (lambda log: log.log_step(4, 0.1, np.eye(3), scalars={"a\\b": 1.0}), "name"),
        (lambda log: log.log_action(4, 0.1, "left"), "action"),
        (lambda log: log.open([]), "open"),
        (lambda log: (log.close(), log.log_step(4, 0.1, np.eye(3))), "closed"),
    ],
)
def test_misuse_is_named(tmp_path: Path, call: Any, message: str) -> None:
    log = open_log(tmp_path / "misuse.rrd")
    with pytest.raises(ValueError, match=message):
        call(log)
    log.close()
    log.close()
    assert read_recording(tmp_path / "misuse.rrd").steps.tolist() == [3], "what was refused left no trace"


def test_bad_arguments(tmp_path: Path) -> None:
    for arguments, message in (
        ({"path": None}, "path"),
        ({"path": tmp_path / "a.mp4"}, "rrd"),
        ({"path": tmp_path / "b.rrd", "batch_steps": 0}, "batch_steps"),
        ({"path": tmp_path / "c.rrd", "port": 70_000}, "port"),
        ({"path": "/proc/nowhere/d.rrd"}, "cannot be written"),
    ):
        with pytest.raises(ValueError, match=message):
            RerunLog(**arguments)
    log = RerunLog(tmp_path / "e.rrd")
    with pytest.raises(ValueError, match="open"):
        log.log_step(0, 0.0, np.eye(3))
    with pytest.raises(ValueError, match="differ"):
        log.open([("a", [[0, 1, 2]], None), ("a", [[0, 1, 2]], None)])
    with pytest.raises(ValueError, match="rows of cloth 'a'"):
        log.open([("a", [[0, 1, 2]], None, slice(0, 2))])
    log.close()


def test_a_simulation_is_logged_without_being_touched(tmp_path: Path) -> None:
    vertices, faces = sheet(4)
    positions = np.concatenate([vertices, vertices + np.array([0, 1, 0])])
    positions.flags.writeable = False
    both = np.concatenate([faces, faces + 16])
    hits = SimpleNamespace(segments=np.zeros((1, 2, 3)), contour=np.array([7]), points=np.ones((1, 3)), length=0.0)
    simulation = SimpleNamespace(
        positions=positions,
        faces=both,
        time=0.25,
        cloth_ranges=[("a", slice(0, 16), slice(0, 18)), ("b", slice(16, 32), slice(18, 36))],
        last_intersections=hits,
        body_meshes=[("ball", vertices, faces)],
        scene=SimpleNamespace(ground=0.1),
    )
    with RerunLog(tmp_path / "sim.rrd") as log:
        log.open_simulation(simulation)
        log.log_simulation(0, simulation, scalars={"max_strain": 0.5})
    found = read_recording(tmp_path / "sim.rrd")
    assert np.array_equal(found.positions(0), positions.astype(np.float32))
    assert np.array_equal(found.cloths["b"].faces, faces)
    assert found.contours[0][1].tolist() == [7]
    assert found.sim_time.tolist() == [0.25]
    assert found.ground == 0.1


def test_recording_leaves_no_trace_in_a_simulation(tmp_path: Path) -> None:
    """The library's own simulation: the same hashes with and without a recording."""
    import clothgym.scenes
    from clothgym.simulation import Simulation

    def hashes(log: RerunLog | None) -> list[str]:
        simulation = Simulation(clothgym.scenes.make("hanging_sheet", resolution=6), fidelity="draft")
        simulation.reset(seed=0)
        found = []
        if log is not None:
            log.open_simulation(simulation)
        for k in range(6):
            if log is not None:
                log.log_simulation(k, simulation, scalars={"max_strain": simulation.metrics()["max_strain"]})
            found.append(simulation.state_hash())
            simulation.step()
        positions.append(simulation.positions.copy())
        return found

    positions: list[np.ndarray] = []
    plain = hashes(None)
    with RerunLog(tmp_path / "sheet.rrd") as log:
        assert hashes(log) == plain
    assert np.array_equal(positions[0], positions[1])
    found = read_recording(tmp_path / "sheet.rrd")
    assert len(found.steps) == 6
    assert sum(track.positions.shape[1] for track in found.cloths.values()) == len(positions[0])
    assert found.sim_time[-1] > 0


def test_documents_survive_as_json(tmp_path: Path) -> None:
    values = {"text": 'quotes " and \\ and 日本', "deep": {"a": [1, [2, {"b": None}]]}, "float": 0.1 + 0.2}
    with RerunLog(tmp_path / "doc.rrd") as log:
        log.open([("sheet", [[0, 1, 2]], None)])
        log.log_step(0, 0.0, np.eye(3))
        log.log_document("episode", values)
        with pytest.raises(ValueError, match="JSON"):
            log.log_document("bad", {"x": float("nan")})
    assert json.dumps(read_recording(tmp_path / "doc.rrd").documents["episode"]) == json.dumps(values)
