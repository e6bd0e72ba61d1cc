"""The bodies of the package: skeleton, poses, limbs, measures."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from clothgym import Surface, intersections, rig
from clothgym.detection.body_mesh import BodyMesh
from clothgym.mesh import face_areas

POSES = ("a_pose", "t_pose", "arms_down", "walk:0", "walk:0.25", "walk:0.6")


@pytest.mark.parametrize(("name", "height"), [("female", 1.590), ("male", 1.730)])
def test_load_gives_a_closed_body_with_skeleton_and_weights(name: str, height: float) -> None:
    loaded = rig.load(name)
    assert loaded.name == name
    assert loaded.vertices.shape == (13380, 3)
    assert loaded.faces.shape == (26756, 3)
    assert loaded.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    assert loaded.vertices[:, 1].max() == pytest.approx(height, abs=2e-3)
    mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0.03  # outside is where the faces run counter-clockwise
    assert len(loaded.bones) == 53
    assert loaded.parent.shape == (53,)
    assert loaded.head.shape == loaded.tail.shape == (53, 3)
    assert loaded.parent[loaded.bone("Root")] == -1
    assert loaded.parent[loaded.bone("calf_l")] == loaded.bone("thigh_l")
    assert loaded.weights.shape == (13380, 53)
    assert np.abs(loaded.weights.sum(axis=1) - 1.0).max() < 1e-12
    assert loaded.weights.min() >= 0.0
    # z to the front: the toes are in front of the ankles
    assert loaded.tail[loaded.bone("foot_l"), 2] > loaded.head[loaded.bone("foot_l"), 2]


def test_bodies_are_read_once_and_cannot_be_written() -> None:
    loaded = rig.load("female")
    assert rig.load("female") is loaded
    with pytest.raises(ValueError, match="read-only"):
        loaded.vertices[0, 0] = 1.0


def test_bad_names_and_values_are_named() -> None:
    female = rig.load("female")
    with pytest.raises(ValueError, match="body = 'dwarf': expected one of female, male"):
        rig.load("dwarf")
    with pytest.raises(ValueError, match="bone = 'wing'"):
        female.posed({"wing": (0.0, 0.0, 1.0)})
    with pytest.raises(ValueError, match=r"rotation of 'head' = \(1, 2\)"):
        female.posed({"head": (1, 2)})
    with pytest.raises(ValueError, match=r"rotation of 'head'.*must not be zero"):
        female.posed({"head": (0, 0, 0, 0)})
    for pose in ("handstand", "walk", "rest:1"):
        with pytest.raises(ValueError, match=f"pose = '{pose}': expected one of rest, a_pose"):
            female.posed(pose)
    for pose in ("walk:1", "walk:x", "walk:-0.1", "walk:nan"):
        with pytest.raises(ValueError, match=rf"pose = '{pose}': expected a phase in \[0, 1\)"):
            female.posed(pose)
    with pytest.raises(ValueError, match="limb 'tail': start = 2"):
        rig.Limb("tail", np.zeros((2, 3)), 2)
    with pytest.raises(ValueError, match="limb 'tail': points: 1 given"):
        rig.Limb("tail", np.zeros((1, 3)), 0)


def _naive(body: rig.Rig, rotations: dict[str, tuple[float, float, float]]) -> np.ndarray:
    """Skinning one vertex at a time, matrices multiplied down the chain of parents, all weights."""
    from scipy.spatial.transform import Rotation

    world = []
    for b, name in enumerate(body.bones):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_rotvec(rotations.get(name, (0.0, 0.0, 0.0))).as_matrix()
        local[:3, 3] = body.head[b] - local[:3, :3] @ body.head[b]
        world.append(local if body.parent[b] < 0 else world[body.parent[b]] @ local)
    out = np.empty_like(body.vertices)
    for v, x in enumerate(body.vertices):
        four = np.argsort(-body.weights[v])[:4]
        share = body.weights[v, four] / body.weights[v, four].sum()
        out[v] = sum(w * (world[b] @ np.append(x, 1.0))[:3] for w, b in zip(share, four))
    return out


def test_posing_agrees_with_skinning_vertex_by_vertex() -> None:
    body = rig.load("male")
    assert np.all(body.parent < np.arange(len(body.bones)))  # parents before children
    rotations = {"spine_02": (0.2, 0.1, 0.0), "upperarm_l": (0.0, -0.3, 0.4), "lowerarm_l": (-0.5, 0.0, 0.1)}
    expected = _naive(body, rotations)
    assert np.abs(expected - body.vertices).max() > 0.2
    gap = np.abs(body.posed(rotations) - expected).max(axis=1)
    assert np.quantile(gap, 0.999) < 1e-12
    assert gap.max() < 0.01  # only where the fourth and the fifth weight are equal
    half = np.cos(0.25), np.sin(0.25)
    assert np.allclose(
        body.posed({"head": (0.0, 0.5, 0.0)}), body.posed({"head": (2 * half[0], 0.0, 2 * half[1], 0.0)})
    )
    whole = body.posed({"Root": (0.0, np.pi / 2, 0.0)}) - body.head[0]
    assert np.allclose(whole, (body.vertices - body.head[0])[:, [2, 1, 0]] * (1, 1, -1), atol=1e-12)


def test_rest_is_the_shape_as_stored() -> None:
    body = rig.load("female")
    assert np.abs(body.posed("rest") - body.vertices).max() < 1e-15
    heads, tails = body.posed_bones("rest")
    assert np.array_equal(heads, body.head)
    assert np.array_equal(tails, body.tail)


@pytest.mark.parametrize("name", rig.NAMES)
def test_arms_are_where_the_pose_says(name: str) -> None:
    body = rig.load(name)
    wrist = {p: body.posed_bones(p)[0][body.bone("hand_l")] for p in (*POSES, "rest")}
    shoulder = body.head[body.bone("upperarm_l")]
    assert wrist["rest"][2] - shoulder[2] > 0.1  # reaches forward
    for pose in ("a_pose", "t_pose", "arms_down"):
        assert abs(wrist[pose][2] - shoulder[2]) < 1e-9
        left, right = body.posed_bones(pose)[0][[body.bone("hand_l"), body.bone("hand_r")]]
        assert np.allclose(left, right * (-1, 1, 1), atol=1e-5)
    assert abs(wrist["t_pose"][1] - shoulder[1]) < 1e-9
    assert wrist["t_pose"][0] > wrist["a_pose"][0] > wrist["arms_down"][0] > shoulder[0] > 0.0  # left is x > 0
    assert wrist["t_pose"][1] > wrist["a_pose"][1] > wrist["arms_down"][1]
    reach = wrist["a_pose"] - shoulder, wrist["arms_down"] - shoulder
    angles = [np.arctan2(-r[1], r[0]) for r in reach]
    assert angles[1] - angles[0] == pytest.approx(0.6, abs=1e-9)


@pytest.mark.parametrize("name", rig.NAMES)
def test_a_stride_alternates(name: str) -> None:
    body = rig.load(name)

    def front(phase: float, bone: str) -> float:
        return float(body.posed_bones(f"walk:{phase}")[0][body.bone(bone), 2])

    for phase, before, behind in ((0.25, "l", "r"), (0.75, "r", "l")):
        assert front(phase, f"foot_{before}") > front(phase, f"foot_{behind}") + 0.4
        assert front(phase, f"hand_{before}") < front(phase, f"hand_{behind}") - 0.2  # opposite arms
    for phase, swinging, standing in ((0.0, "l", "r"), (0.5, "r", "l")):
        heads = body.posed_bones(f"walk:{phase}")[0]
        assert heads[body.bone(f"foot_{swinging}"), 1] > heads[body.bone(f"foot_{standing}"), 1] + 0.05
    early, late = (np.array([front(p, "foot_l")]) for p in (0.95, 0.05))
    assert late > early  # the lifted foot comes forward
    assert np.abs(body.posed("walk:0.999999") - body.posed("walk:0")).max() < 1e-4
    toe = body.bone("ball_l")
    for phase in (0.0, 0.3, 0.6):  # knees and elbows bend the human way
        heads = body.posed_bones(f"walk:{phase}")[0]
        hip, knee, ankle = (heads[body.bone(f"{b}_l")] for b in ("thigh", "calf", "foot"))
        assert np.cross(knee - hip, ankle - knee)[0] > 0.0
        assert heads[toe, 2] > ankle[2]


@pytest.mark.parametrize("name", rig.NAMES)
def test_poses_do_not_collapse_the_skin(name: str) -> None:
    body = rig.load(name)
    volume = trimesh.Trimesh(body.vertices, body.faces, process=False).volume
    areas = face_areas(body.vertices, body.faces)
    surface = Surface(body.faces, len(body.vertices))
    at_rest = intersections(body.vertices, surface).length
    for pose in POSES:
        x = body.posed(pose)
        assert trimesh.Trimesh(x, body.faces, process=False).volume == pytest.approx(volume, rel=0.012)
        ratio = face_areas(x, body.faces) / areas
        assert np.quantile(ratio, 0.001) > 0.4
        assert ratio.max() < 4.0
        crossing = intersections(x, surface).length - at_rest
        assert crossing < (0.5 if pose == "arms_down" else 1e-3)  # armpits; the female's hands in the thighs


@pytest.mark.parametrize("pose", ["rest", *POSES])
def test_limbs_run_inside_the_body_and_leave_it_at_the_tip(pose: str) -> None:
    igl = pytest.importorskip("igl")
    body = rig.load("female")
    limbs = body.limbs(pose)
    assert [limb.name for limb in limbs] == ["head", "left_arm", "right_arm", "left_leg", "right_leg"]
    x = body.posed(pose)
    true = BodyMesh(x, body.faces)
    heads, _ = body.posed_bones(pose)
    proper = {"head": "neck_01", "left_arm": "upperarm_l", "right_arm": "upperarm_r", "left_leg": "thigh_l",
              "right_leg": "thigh_r"}  # fmt: skip
    for limb in limbs:
        assert np.array_equal(limb.points[0], limbs[0].points[0])  # the chest
        assert np.array_equal(limb.points[limb.start], heads[body.bone(proper[limb.name])])
        assert np.linalg.norm(limb.points[-1] - limb.points[-2]) == pytest.approx(1.0)
        inner = limb.points[:-1]
        share = np.linspace(0.0, 1.0, 20)[:, None, None]
        path = ((1 - share) * inner[:-1] + share * inner[1:]).transpose(1, 0, 2).reshape(-1, 3)
        fingers = 45 if limb.name.endswith("arm") else 0  # bones of bent fingers and the tip cut corners
        path = path[: len(path) - fingers]
        turns = igl.winding_number(x, body.faces, path)  # right in the armpits of lowered arms as well
        assert ((turns > 0.5) | (true.signed_distance(path) < 2e-3)).all(), limb.name
        assert true.signed_distance(limb.points[-1:])[0] > 0.3
        again = rig.Limb.from_json(limb.to_json())
        assert np.array_equal(again.points, limb.points)
        assert (again.name, again.start) == (limb.name, limb.start)
    with pytest.raises(ValueError, match=r"limb\.colour: unknown or missing field"):
        rig.Limb.from_json(limbs[0].to_json() | {"colour": 1})


def test_girth_of_a_known_shape() -> None:
    tube = trimesh.creation.cylinder(radius=0.3, height=1.0, sections=64)
    x = np.asarray(tube.vertices)[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    assert rig.girth(x, np.asarray(tube.faces), 0.1) == pytest.approx(64 * 2 * 0.3 * np.sin(np.pi / 64), rel=1e-9)
    two = np.concatenate([x, x + np.array([1.0, 0.0, 0.0])])
    faces = np.concatenate([tube.faces, tube.faces + len(x)])
    assert rig.girth(two, faces, 0.1) == pytest.approx(2.0 + 2 * np.pi * 0.3, rel=1e-3)  # the tape spans both
    assert rig.girth(x, np.asarray(tube.faces), 0.6) == 0.0


@pytest.mark.parametrize("name", rig.NAMES)
def test_measures_are_those_of_a_person(name: str) -> None:
    body = rig.load(name)
    m = body.measures("a_pose")
    assert m.height == pytest.approx(np.ptp(body.vertices[:, 1]))
    assert m.hip_height < m.waist_height < m.bust_height < m.shoulder_height < 0.85 * m.height
    assert m.waist_girth < min(m.bust_girth, m.hip_girth)
    assert 0.35 * m.height < m.waist_girth < 0.5 * m.height
    joint = body.head[body.bone("upperarm_l")]
    assert 0.02 < m.shoulder_height - joint[1] < 0.08
    assert BodyMesh(body.vertices, body.faces).signed_distance([m.chest_centre])[0] < -0.05
    arms = body.posed("a_pose")[:, 0]
    assert m.bust_girth < 2.0 * np.ptp(arms)
    assert body.measures("rest").waist_girth == pytest.approx(m.waist_girth, rel=1e-3)
