"""Every field of the fidelity changes what a simulation does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from small_scenes import CONTACT, GLOBAL, SOFT, pile, tangle

import clothgym as cg


def outcome(make, fidelity, speed: float = 0.0):
    """Everything that a knob can change: stage names, step, work counters, box tests, and the state."""
    sim = cg.Simulation(make(), fidelity)
    if speed:
        rng = np.random.default_rng(1)
        sim.set_velocities(rng.normal(0, speed, sim.positions.shape))
    sim.step(4)
    tree = getattr(getattr(sim.pipeline.stages[0], "candidates", None), "tree", None)
    return sim.pipeline.describe(), sim.state_hash(), getattr(tree, "box_tests", None), sim.metrics()["work"]


def lone_sheet():
    return dataclasses.replace(cg.scenes.make("hanging_sheet", resolution=4), self_collision=True)


def on_ball():
    """A sheet that lies on a ball finer than its own cells."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    mesh = cg.grid(0.3, 0.3, 6, 6).transformed(translation=(0.02, 0.2005, 0.01))
    return cg.Scene([cg.Cloth(mesh)], bodies=[cg.Body(ball, slide=0.5)], step=0.01, self_collision=False)


def through_ball() -> cg.Scene:
    """A sheet with its middle inside a ball."""
    return dataclasses.replace(
        on_ball(),
        cloths=[cg.Cloth(cg.grid(0.6, 0.6, 6, 6).transformed(translation=(0.02, 0.1505, 0.01)))],
        self_collision=True,
    )


def bent() -> cg.Scene:
    """A strip that lies bent: where it is and its pattern differ."""
    flat = cg.grid(0.6, 0.2, 12, 4)
    x, _, z = flat.vertices.T
    start = np.stack([0.15 * np.sin(x / 0.15), 0.3 - 0.15 * np.cos(x / 0.15), z], axis=1)
    return cg.Scene([cg.Cloth(cg.Mesh(start, flat.faces, flat.quads), SOFT, rest=flat.vertices)], step=0.01)


def hanging():
    return cg.scenes.make("hanging_sheet", resolution=16)


EULER = cg.Fidelity(integrator="symplectic_euler", substeps=0)
SEARCH = dataclasses.replace(CONTACT, flat_check=False)
STEEP = dataclasses.replace(EULER, velocity_modification="relative", stretch_limit=0.0)
MEZGER = dataclasses.replace(CONTACT, detection="mezger")
CURVATURE = dataclasses.replace(MEZGER, cones="mezger")
CHOSEN = cg.Fidelity()
IMPLICIT = cg.Fidelity(integrator="implicit_euler", substeps=2)
KNOBS = {
    "integrator": (pile, CONTACT, "symplectic_euler", 0, "state"),
    "membrane": (pile, CONTACT, "continuum", 0, "state"),
    "bending": (pile, CONTACT, "hinge", 0, "state"),
    "substeps": (pile, CONTACT, 6, 0, "state"),
    "sweeps": (pile, CONTACT, 6, 0, "state"),
    "contact_substeps": (pile, dataclasses.replace(CONTACT, substeps=0), 6, 0, "state"),
    "stretch_error": (hanging, CHOSEN, 0.05, 0, "state"),
    "precision": (hanging, CHOSEN, "float32", 0, "state"),
    "time_order": (pile, IMPLICIT, 1, 0, "state"),
    "tolerance": (pile, IMPLICIT, 1e-4, 2, "state"),
    "solver_steps": (pile, IMPLICIT, 1, 2, "state"),
    "velocity_modification": (pile, STEEP, "literal", 2, "state"),
    "position_modification": (pile, dataclasses.replace(EULER, stretch_limit=0.0), 2, 2, "state"),
    "stretch_limit": (pile, STEEP, 0.2, 2, "state"),
    "detection": (pile, CONTACT, "brute_force", 0, "work"),
    "k": (pile, SEARCH, 26, 0, "boxes"),
    "arity": (pile, SEARCH, 2, 0, "boxes"),
    "flat_check": (lone_sheet, CONTACT, False, 0, "work"),
    "inflation": (pile, MEZGER, "unoriented", 1, "work"),
    "cones": (pile, MEZGER, "none", 0, "work"),
    "close_angle": (pile, CURVATURE, 0.01, 0, "work"),
    "leaf_angle": (pile, CURVATURE, 0.5, 0, "work"),
    "wide_angle": (pile, dataclasses.replace(MEZGER, inflation="conservative"), 0.0, 1, "boxes"),
    "face_groups": (pile, CURVATURE, 4, 0, "work"),
    "lazy": (pile, MEZGER, 1e-4, 0, "work"),
    "coherence": (pile, MEZGER, 1e-3, 0, "work"),
    "separation_list": (pile, MEZGER, 4, 0, "boxes"),
    "build_space": (bent, MEZGER, "pattern", 0, "boxes"),
    "rebuild_growth": (pile, SEARCH, 1.01, 2, "work"),
    "repair_rounds": (pile, CONTACT, 0, 20, "state"),
    "continuous": (tangle, dataclasses.replace(GLOBAL, untangling="none", rings=4), True, 1, "work"),
    "untangling": (tangle, GLOBAL, "local", 0, "state"),
    "untangling_passes": (tangle, GLOBAL, 3, 0, "state"),
    "h0": (tangle, GLOBAL, 0.3, 0, "state"),
    "g0": (tangle, GLOBAL, 5.0, 0, "state"),
    "displacement_share": (tangle, GLOBAL, 0.5, 0, "state"),
    "velocity_share": (tangle, GLOBAL, 0.5, 0, "state"),
    "acceleration_share": (tangle, GLOBAL, 0.5, 0, "state"),
    "penalty_stiffness": (tangle, GLOBAL, 10.0, 0, "state"),
    "untangle_bodies": (through_ball, GLOBAL, True, 0, "state"),
    "easing": (tangle, GLOBAL, 0, 0, "state"),
    "speed_limit": (tangle, GLOBAL, 0.1, 0, "state"),
    "contacts_near_hits": (tangle, GLOBAL, "keep", 0, "state"),
    "rings": (tangle, GLOBAL, 0, 0, "state"),
    "yield_force": (tangle, dataclasses.replace(GLOBAL, contacts_near_hits="yield"), 5.0, 0, "state"),
    "map_size": (on_ball, CONTACT, 60, 0, "state"),
    "body_tolerance": (on_ball, CONTACT, 5e-3, 0, "state"),
    "body_faces": (on_ball, CONTACT, 0, 0, "state"),
    "body_texels": (on_ball, CONTACT, True, 0, "state"),
    "body_collider": (on_ball, CONTACT, "dop", 0, "state"),
    "body_normals": (on_ball, CONTACT, "interpolated", 0, "state"),
    "body_views": (on_ball, CONTACT, "z", 0, "state"),
    "body_response": (on_ball, CONTACT, "velocity", 0, "state"),
}
"""Field: scene, base, other value, initial speed, and what must change."""


def test_every_field_of_fidelity_has_a_knob_test():
    assert set(KNOBS) == {field.name for field in dataclasses.fields(cg.Fidelity)}


@pytest.mark.parametrize("field", KNOBS)
def test_no_dead_knobs(field):
    make, base, value, speed, what = KNOBS[field]
    changed = {field: value} | ({"substeps": 0} if field == "integrator" else {})
    one = outcome(make, base, speed)
    assert outcome(make, base, speed) == one, "the comparison is not deterministic"
    two = outcome(make, dataclasses.replace(base, **changed), speed)
    part = {"state": 1, "boxes": 2, "work": 3}[what]
    assert one[part] != two[part]


def test_every_way_with_contacts_near_hits_is_its_own():
    ways = ("off_any", "off_both", "yield", "limited", "keep")
    assert len({outcome(tangle, dataclasses.replace(GLOBAL, contacts_near_hits=way))[1] for way in ways}) == 5


def test_brute_force_and_hierarchy_give_the_same_physics():
    """Pairs come in another order, so bits may differ; what is found may not."""
    found = []
    for detection in ("hierarchy", "brute_force"):
        sim = cg.Simulation(tangle(), dataclasses.replace(GLOBAL, detection=detection))
        hits = sim.last_intersections.hit_count
        sim.step()
        found.append((hits, sim.metrics()["work"]["hits"], sim.positions.copy()))
    assert found[0][:2] == found[1][:2]
    assert found[0][1] > 10
    assert found[0][2] == pytest.approx(found[1][2], abs=1e-4)
