"""Sizes of bodies, and the patterns drafted to them."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import trimesh

import clothgym as cg
from clothgym import body as bodies
from clothgym import rig, wardrobe
from clothgym.detection.body_mesh import BodyMesh
from clothgym.dressing.draping import _Fitting, placed
from clothgym.dressing.worn import what_is_wrong
from clothgym.garment import assemble
from clothgym.pattern import Pattern
from clothgym.sizes import Section, sizes

LIMBS = {
    "cuff": ["left_arm", "left_arm"],
    "dress": ["head", "left_arm", "right_arm", "legs"],
    "scarf": ["head", "head"],
    "shirt": ["head", "left_arm", "right_arm", "legs"],
    "shorts": ["legs", "left_leg", "right_leg"],
    "skirt": ["legs", "legs"],
    "sleeve": ["left_arm", "left_arm"],
    "sleeveless_shirt": ["head", "left_arm", "right_arm", "legs"],
    "t_shirt": ["head", "left_arm", "right_arm", "legs"],
    "trousers": ["legs", "left_leg", "right_leg"],
    "vest": ["head", "left_arm", "right_arm", "legs"],
}


@pytest.fixture(scope="module", params=rig.NAMES)
def person(request: pytest.FixtureRequest) -> cg.Body:
    return bodies.load(request.param)


def test_sizes_agree_with_the_skeleton(person: cg.Body):
    """Measured on the surface alone, against what the rig measures with its bones and skinning weights."""
    taken, known = sizes(person), rig.load(person.name).measures()
    assert taken.height == pytest.approx(known.height, abs=1e-6)
    assert taken.waist_girth == pytest.approx(known.waist_girth, rel=0.01)
    assert taken.hip_girth == pytest.approx(known.hip_girth, rel=0.01)
    assert taken.bust_girth == pytest.approx(known.bust_girth, rel=0.05)
    assert taken.waist_height == pytest.approx(known.waist_height, abs=0.015)
    assert taken.shoulder_height == pytest.approx(known.shoulder_height, abs=0.02)
    assert taken.ankle_height < taken.knee_height < taken.crotch_height < taken.hip_height < taken.waist_height
    assert taken.waist_height < taken.bust_height < taken.armpit_height < taken.shoulder_height < taken.neck_height
    for arm in (taken.left_arm, taken.right_arm):
        assert arm.wrist_girth < arm.elbow_girth < arm.upper_girth
    assert taken.left_arm.length == pytest.approx(taken.right_arm.length, rel=1e-6)
    assert taken.inseam == taken.crotch_height - taken.ankle_height


def test_a_bare_mesh_has_the_same_sizes(person: cg.Body):
    bare = sizes(cg.Body((person.mesh.vertices, person.mesh.faces), "stranger"))
    for name in (
        "waist_girth",
        "hip_girth",
        "bust_girth",
        "thigh_girth",
        "neck_girth",
        "crotch_height",
        "armpit_height",
    ):
        assert getattr(bare, name) == getattr(sizes(person), name)
    assert bare.shoulder_half == pytest.approx(sizes(person).shoulder_half, rel=0.1)
    assert bare.left_arm.wrist == pytest.approx(sizes(person).left_arm.wrist, abs=0.08)


def test_sections_fall_apart():
    """Two cylinders side by side are two parts whose girths are circles'."""
    one, two = (trimesh.creation.cylinder(r, 1.0, sections=64) for r in (0.1, 0.05))
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    for mesh in (one, two):
        mesh.apply_transform(turn)
    two.apply_translation([0.3, 0, 0])
    both = trimesh.util.concatenate([one, two])
    section = Section(np.asarray(both.vertices), np.asarray(both.faces), 0.11)
    assert len(section.parts) == 2
    assert section.part_at(0.2) is None
    assert section.part_at(0.29)[:, 0].min() == pytest.approx(0.25, abs=1e-3)
    assert np.ptp(section.part_at(0.01)[:, 0]) == pytest.approx(0.2, abs=1e-3)


def test_who_cannot_be_measured_is_told():
    ball = cg.Body(trimesh.creation.icosphere(3), "ball")
    with pytest.raises(ValueError, match=r"body 'ball': no .* where a standing person"):
        sizes(ball)


@pytest.mark.parametrize("name", wardrobe.NAMES)
def test_patterns_are_placed_around_the_body_and_sewn_on(name: str, person: cg.Body):
    pattern, notes = placed(name, person)
    exact = BodyMesh(person.mesh.vertices, person.mesh.faces)
    panels = np.concatenate([panel.placed(panel.outline(0.04)) for panel in pattern.panels])
    assert exact.signed_distance(panels).min() > 0.01, notes
    fitting = _Fitting(pattern, person, cg.Fidelity.preset("draft"), 0.025)
    garment, x, _ = fitting.sew(0.0)
    found = fitting.worn(garment, x)
    assert sorted(w.expected for w in found) == sorted(LIMBS[name])
    assert not what_is_wrong(found)
    assert exact.depth(x).max() < 4e-3, "in the armpits, before the drape"


@pytest.mark.parametrize("name", wardrobe.NAMES)
def test_patterns_follow_the_body_and_survive_json(name: str, person: cg.Body):
    pattern = wardrobe.tailored(name, person)
    text = json.dumps(pattern.to_json())
    again = Pattern.from_json(text, name)
    assert again.to_json() == json.loads(text)
    for one, two in zip(pattern.panels, again.panels):
        assert two.placed(two.vertices) == pytest.approx(one.placed(one.vertices), abs=1e-9)
    assert len(assemble(again, 0.05).openings) == len(LIMBS[name])
    half = dataclasses.replace(person, mesh=(0.5 * person.mesh.vertices, person.mesh.faces), limbs=())
    assert len(wardrobe.tailored(name, half).panels) == len(pattern.panels)


def test_girths_have_their_ease(person: cg.Body):
    """Twice the width of front and back at the hips is the hips' girth and some."""
    taken = sizes(person)
    skirt = wardrobe.tailored("skirt", person).panel("front")
    points = skirt.placed(skirt.outline(0.005))
    at_hip = points[np.abs(points[:, 1] - taken.hip_height) < 0.006]
    assert 1.04 < 4 * np.abs(at_hip[:, 0] - taken.centre).max() / taken.hip_girth < 1.25


def test_names_that_are_none():
    with pytest.raises(ValueError, match="pattern = 'cloak'"):
        wardrobe.tailored("cloak", bodies.load("female"))
