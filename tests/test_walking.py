"""Bodies that move, and a walk in a dress."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import body as bodies
from clothgym import rig
from clothgym.dressing import walk
from clothgym.motion import Motion


def rising_ball(speed: float = 0.2) -> cg.Body:
    ball = trimesh.creation.icosphere(3, radius=0.1)
    start = np.asarray(ball.vertices)
    frames = [start + np.array([0.0, speed * n / 60.0, 0.0]) for n in range(121)]
    return cg.Body(ball, "ball", motion=Motion(np.array(frames), 60.0))


def sheet_above(height: float) -> cg.Cloth:
    mesh = cg.grid(0.3, 0.3, 10, 10)
    return cg.Cloth(mesh.transformed(translation=(0.0, height, 0.0)), rest=mesh.vertices, name="sheet")


def test_motion_is_straight_between_frames_and_loops():
    frames = np.arange(5.0)[:, None, None] * np.ones((1, 2, 3))
    once, forever = Motion(frames, 10.0), Motion(frames, 10.0, 2)
    for time, first, second in (
        (-1.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.25, 2.5, 2.5),
        (0.4, 4.0, 4.0),
        (0.45, 4.0, 3.0),
        (0.5, 4.0, 2.0),
        (0.83, 4.0, 2.3),
    ):
        assert once.at(time) == pytest.approx(np.full((2, 3), first), abs=1e-6)
        assert forever.at(time) == pytest.approx(np.full((2, 3), second), abs=1e-6)
    again = Motion.from_json(forever.to_json())
    assert np.array_equal(again.frames, forever.frames) and (again.rate, again.loop_from) == (10.0, 2)


def test_bad_motions_are_told():
    with pytest.raises(ValueError, match=r"motion: frames: expected \(T, V, 3\)"):
        Motion(np.zeros((4, 3)))
    with pytest.raises(ValueError, match=r"motion: frames\[1, 0, 2\] is not finite"):
        Motion(np.array([[[0.0, 0, 0]], [[0, 0, np.nan]]]))
    with pytest.raises(ValueError, match="motion: loop_from = 7"):
        Motion(np.zeros((2, 1, 3)), 60.0, 7)
    with pytest.raises(ValueError, match="motion: frames of 2 vertices, the mesh has"):
        cg.Body(trimesh.creation.icosphere(1), motion=Motion(np.zeros((3, 2, 3))))


def test_a_rising_ball_lifts_the_sheet_on_it():
    scene = cg.Scene((sheet_above(0.105),), bodies=(rising_ball(),), self_collision=False)
    assert "move bodies" in cg.Simulation(scene, "draft").pipeline.describe()
    simulation = cg.Simulation(scene, "draft")
    simulation.step(30)
    top = simulation.positions[:, 1].max()
    simulation.step(60)
    assert simulation.positions[:, 1].max() - top == pytest.approx(0.2, abs=0.01)
    assert simulation.body_mesh.signed_distance([[0.0, 0.3, 0.0]])[0] == pytest.approx(-0.1, abs=2e-3), (
        "the ball has come up"
    )
    assert simulation.penetration_depth() < 2e-3
    still = cg.Simulation(
        dataclasses.replace(scene, bodies=(dataclasses.replace(rising_ball(), motion=None),)), "draft"
    )
    assert "move bodies" not in still.pipeline.describe()


def test_motion_belongs_to_the_time():
    """Reset, snapshots and JSON bring the body back to where it was: the same bits."""
    scene = cg.Scene((sheet_above(0.105),), bodies=(rising_ball(),), self_collision=False)
    simulation = cg.Simulation(scene, "draft")
    simulation.step(5)
    kept = simulation.snapshot()
    simulation.step(5)
    end = simulation.state_hash()
    simulation.restore(kept)
    simulation.step(5)
    assert simulation.state_hash() == end
    simulation.reset()
    simulation.step(10)
    assert simulation.state_hash() == end
    other = cg.Simulation(cg.Scene.from_json(scene.to_json()), "draft")
    other.step(10)
    assert other.state_hash() == end


def test_a_walk_begins_in_its_pose_and_joins_its_loop():
    skeleton = rig.load("female")
    motion = skeleton.walk("a_pose", stride=1.2, rate=10.0)
    assert motion.at(0.0) == pytest.approx(skeleton.posed("a_pose"), abs=1e-6)
    assert motion.at(1.0) == pytest.approx(skeleton.posed("walk:0.0"), abs=1e-6)
    assert motion.at(1.3) == pytest.approx(skeleton.posed("walk:0.25"), abs=1e-6)
    assert motion.at(2.5) == pytest.approx(skeleton.posed("walk:0.25"), abs=1e-6)
    assert skeleton.posed(skeleton.blended("rest", "t_pose", 0.0)) == pytest.approx(skeleton.posed("rest"), abs=1e-9)
    assert skeleton.posed(skeleton.blended("rest", "t_pose", 1.0)) == pytest.approx(skeleton.posed("t_pose"), abs=1e-9)


def test_shorts_stay_on_for_some_steps():
    shorts = cg.drape("shorts", "female", edge_length=0.05, fidelity="draft")
    assert shorts.report["worn"]
    walked = walk(shorts, 0.5)
    assert walked.report["worn"] and walked.report["walk_seconds"] == pytest.approx(0.5)
    assert walked.report["depth_p99_max"] < 5e-3
    assert len(walked.frames) == 30 and np.isfinite(walked.simulation.positions).all()


def test_a_walk_needs_a_skeleton():
    woman = bodies.load("female")
    shorts = cg.drape("cuff", woman, edge_length=0.05, fidelity="draft", seconds=0.1)
    stranger = dataclasses.replace(shorts, body=dataclasses.replace(woman, name="stranger"))
    with pytest.raises(ValueError, match="walk: body 'stranger': has no skeleton"):
        walk(stranger, 0.1)
    with pytest.raises(ValueError, match="walk: garments: none given"):
        walk([], 0.1)
