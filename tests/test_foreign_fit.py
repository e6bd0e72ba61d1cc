"""Patterns as other programs write them, fitted to bodies that they were not made for: where they are put, what they are taken
for, and that they come to be worn."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import garmentcode
import numpy as np
import pytest

import clothgym as cg
from clothgym import body as bodies
from clothgym import wardrobe
from clothgym.detection.openings import LEGS, Threading, expectation, nearest_on
from clothgym.dressing import placement, scaling, wearer
from clothgym.dressing.cut import read
from clothgym.dressing.draping import _Fitting
from clothgym.dressing.sewing import opening_lengths
from clothgym.dressing.worn import paths
from clothgym.fidelity import Fidelity
from clothgym.garment import assemble
from clothgym.pattern import Pattern
from clothgym.sizes import sizes

COARSE = 0.03
DEPTH = 20.0
"""[cm] panels stand so far before and behind x, z = 0."""
TORSO = [[-24, -60], [24, -60], [24, -22], [18, -3], [11, 0], [-11, 0], [-18, -3], [-24, -22]]
SLEEVE = [[24, -22], [44, -20], [44, -4], [18, -3]]


@pytest.fixture(scope="module")
def woman() -> cg.Body:
    return bodies.load("female")


@pytest.fixture(scope="module")
def man() -> cg.Body:
    return bodies.load("male")


def bare(body: cg.Body) -> cg.Body:
    """The same surface, of which nobody knows where its limbs are."""
    return cg.Body((body.mesh.vertices, body.mesh.faces), name="bare")


def mirrored(outline: list[list[float]]) -> list[list[float]]:
    """The other half: counter-clockwise too, edge k has become edge N - 1 - k."""
    return [[-x, y] for x, y in [outline[0], *outline[:0:-1]]]


def pair(name: str, outline: list[list[float]]) -> dict[str, Any]:
    """A front counter-clockwise and the same clockwise behind: its edge k is edge N - 2 - k there."""
    return {
        f"{name}_f": garmentcode.panel(outline, translation=[0, 0, DEPTH]),
        f"{name}_b": garmentcode.panel(outline[::-1], translation=[0, 0, -DEPTH]),
    }


def together(name: str, edges: list[int], count: int) -> list[Any]:
    """Front and back sewn at these edges."""
    return [garmentcode.stitch(f"{name}_f", k, f"{name}_b", (count - 2 - k) % count) for k in edges]


def tee() -> Pattern:
    """Its sleeves stand level, as for a body in T pose, and its origin is at the neck."""
    panels = pair("torso", TORSO) | pair("left", SLEEVE) | pair("right", mirrored(SLEEVE))
    stitches = [*together("torso", [1, 3, 5, 7], 8), *together("left", [0, 2], 4), *together("right", [1, 3], 4)]
    for side, at_torso, at_sleeve in (("left", 2, 3), ("right", 6, 0)):
        stitches.append(garmentcode.stitch("torso_f", at_torso, f"{side}_f", at_sleeve))
        stitches.append(garmentcode.stitch("torso_b", (6 - at_torso) % 8, f"{side}_b", (2 - at_sleeve) % 4))
    return Pattern.from_json(garmentcode.document(panels, stitches), "tee")


def waistcoat() -> Pattern:
    """Open in front."""
    half = [[1, -60], [24, -60], [24, -22], [18, -3], [11, 0], [1, -10]]
    panels = {
        "back": garmentcode.panel(TORSO[::-1], translation=[0, 0, -DEPTH]),
        "one": garmentcode.panel(half, translation=[0, 0, DEPTH]),
        "other": garmentcode.panel(mirrored(half), translation=[0, 0, DEPTH]),
    }
    stitches = [
        garmentcode.stitch("one", 1, "back", 5),
        garmentcode.stitch("one", 3, "back", 3),
        garmentcode.stitch("other", 4, "back", 7),
        garmentcode.stitch("other", 2, "back", 1),
    ]
    return Pattern.from_json(garmentcode.document(panels, stitches), "waistcoat")


def bodice() -> Pattern:
    """Without straps: 86 cm around at its top, 70 at its waist, 98 at its hem."""
    outline = [[-24.5, -40], [24.5, -40], [17.5, -18], [21.5, 0], [-21.5, 0], [-17.5, -18]]
    stitches = together("tube", [1, 2, 4, 5], 6)
    return Pattern.from_json(garmentcode.document(pair("tube", outline), stitches), "bodice")


def rewritten(name: str, body: cg.Body) -> Pattern:
    """A pattern of the package cut to a body, through a file, with other names and its origin at the pelvis."""
    values = wardrobe.tailored(name, body).moved((0.0, -1.0, 0.0)).to_json()
    panels = values["pattern"]["panels"]
    names = {old: f"piece {n}" for n, old in enumerate(panels)}
    values["pattern"]["panels"] = {names[old]: panel for old, panel in panels.items()}
    values["pattern"]["panel_order"] = [names[old] for old in values["pattern"]["panel_order"]]
    for stitch in values["pattern"]["stitches"]:
        for side in stitch[:2]:
            side["panel"] = names[side["panel"]]
    return Pattern.from_json(values, name)


def sewn_wrong(pattern: Pattern, body: cg.Body) -> list[str]:
    """Openings of a fitted and sewn garment that are not worn, by what was expected."""
    fitted, _ = placement.fit(pattern, body)
    fitting = _Fitting(fitted, body, Fidelity(), COARSE)
    garment, x, _ = fitting.sew(0.0)
    return [opening.expected for opening in fitting.worn(garment, x) if not opening.right]


# What a garment is cut for


def test_cuts_of_all_kinds(woman: cg.Body):
    def told(pattern: Pattern) -> tuple[int, int, int, bool]:
        cut = read(assemble(pattern, COARSE))
        return len(cut.arms), len(cut.legs), len(cut.around), len(cut.shoulders) > 0

    assert told(rewritten("trousers", woman)) == (0, 2, 1, False)
    assert told(rewritten("skirt", woman)) == (0, 0, 2, False)
    assert told(rewritten("shirt", woman)) == (2, 0, 2, True)
    assert told(tee()) == (2, 0, 2, True)
    assert told(waistcoat()) == (2, 0, 1, True)
    assert told(bodice()) == (0, 0, 2, False)


def test_a_cut_does_not_depend_on_where_the_origin_is(woman: cg.Body):
    here = read(assemble(rewritten("trousers", woman), COARSE))
    there = read(assemble(rewritten("trousers", woman).moved((2.0, 0.7, -0.4)), COARSE))
    assert there.legs == here.legs and there.middle == pytest.approx(here.middle + 2.0, abs=1e-9)
    assert here.crotch is not None
    assert there.crotch == pytest.approx(here.crotch + np.array([2.0, 0.7, -0.4]), abs=1e-9)


def test_each_limb_has_one_way_out(woman: cg.Body):
    def limbs(pattern: Pattern) -> list[str]:
        found = read(assemble(pattern, COARSE)).limbs()
        assert found is not None
        assert len({name for group in found for name in group}) == sum(len(group) for group in found) == 5
        return sorted(expectation(group) for group in found)

    assert limbs(tee()) == ["head", "left_arm", LEGS, "right_arm"]
    assert limbs(rewritten("trousers", woman)) == ["left_leg", LEGS, "right_leg"]
    assert limbs(waistcoat()) == ["head + left_leg + right_leg", "left_arm", "right_arm"]
    assert limbs(bodice()) == [LEGS, LEGS]


# Where it is put


def test_trousers_hang_by_waist_and_crotch(woman: cg.Body):
    """Their waistband is wider than the waist by its ease: by that alone they stood 94 mm too low, the hems in the feet."""
    meant = read(assemble(wardrobe.tailored("trousers", woman), COARSE)).crotch
    fitted, _ = placement.fit(rewritten("trousers", woman), woman)
    crotch = read(assemble(fitted, COARSE)).crotch
    assert meant is not None and crotch is not None
    assert abs(crotch[1] - meant[1]) < 0.025
    assert crotch[1] < sizes(woman).crotch_height


@pytest.mark.parametrize("share", [0.85, 1.0, 1.15])
def test_a_crotch_is_never_above_that_of_the_body(woman: cg.Body, share: float):
    fitted, _ = placement.fit(rewritten("trousers", woman).scaled(share), woman)
    crotch = read(assemble(fitted, COARSE)).crotch
    assert crotch is not None and crotch[1] < sizes(woman).crotch_height


def test_what_has_no_straps_is_put_to_the_bust(woman: cg.Body):
    """By the length of its top alone it would be hung around the hips."""
    fitted, _ = placement.fit(bodice(), woman)
    garment, s = assemble(fitted, COARSE), sizes(woman)
    top = garment.vertices[garment.openings[0], 1]
    assert s.waist_height + 0.1 < top.mean() and top.max() < s.armpit_height
    assert sewn_wrong(bodice(), woman) == []


def test_a_sleeve_goes_to_the_arm(woman: cg.Body, man: cg.Body):
    """It went to the waist."""
    pattern = rewritten("sleeve", woman).moved((0.0, 1.0, 0.0))
    _, notes = placement.fit(pattern, man)
    assert "left arm" in notes[0]
    assert sewn_wrong(pattern, man) == []


def test_level_sleeves_are_turned_to_the_arms(woman: cg.Body):
    """The arms hang at 45 degrees: sleeves that stand level close above them."""
    _, notes = placement.fit(tee(), woman)
    assert sum("sleeve turned by" in note for note in notes) == 2
    assert sewn_wrong(tee(), woman) == []
    assert sewn_wrong(tee(), bare(woman)) == []


def test_bent_arms_are_found_without_a_skeleton(woman: cg.Body, man: cg.Body):
    """The straight way from the shoulder to the fingers passes 7 cm beside the elbow."""
    for body in (woman, man):
        for side, arm in wearer.arms(bare(body)).items():
            true = wearer.arms(body)[side]
            feet = nearest_on(arm.points[1:], true.points[true.start :])
            assert np.linalg.norm(feet - arm.points[1:], axis=1).max() < 0.03


def test_an_open_front_is_worn(woman: cg.Body):
    """Its border goes around head and legs at once; only the arms have openings of their own."""
    assert sewn_wrong(waistcoat(), woman) == []


def test_a_fitted_file_is_draped_to_rest(woman: cg.Body):
    result = cg.drape(rewritten("trousers", woman), woman, edge_length=COARSE)
    assert result.report["worn"] and result.report["at_rest"] and result.report["hits"] == 0
    assert result.report["penetration_max"] <= 2e-3 and result.report["attempts"] == 1


# How large it is made


@pytest.mark.parametrize("name", ["shorts", "trousers"])
def test_the_edge_of_a_waistband_is_no_bust(woman: cg.Body, man: cg.Body, name: str):
    """Above the waist only corners of the waistband stood, 45 % of a bust: all was made 2.18 times as large."""
    for body in (man, bare(man)):
        _, notes = placement.fit(rewritten(name, woman), body)
        scales = [float(note.split("scaled by ")[1].split(":")[0]) for note in notes if "scaled by" in note]
        assert all(0.9 < scale < 1.3 for scale in scales)


def test_girths_go_on_across_panels_that_stand_apart():
    """A skirt of two panels 20 cm wide at the sides and two of 30 in front and behind, all far from each other."""
    turned = {"rotation": [0, 90, 0]}
    panels = {
        "f": garmentcode.rectangle(30, 50, translation=[0, 0, 60]),
        "l": garmentcode.rectangle(20, 50, translation=[70, 0, 0], **turned),
        "b": garmentcode.rectangle(30, 50, translation=[0, 0, -60], rotation=[0, 180, 0]),
        "r": garmentcode.rectangle(20, 50, translation=[-70, 0, 0], rotation=[0, -90, 0]),
    }
    ring = ["f", "l", "b", "r"]
    stitches = [garmentcode.stitch(a, 1, b, 3) for a, b in zip(ring, [*ring[1:], ring[0]])]
    pattern = Pattern.from_json(garmentcode.document(panels, stitches), "apart")
    garment = assemble(pattern, COARSE)
    girth = scaling.Girths(pattern, garment, read(garment)).at(0.0)
    assert girth == pytest.approx(1.0, abs=1e-9)


def test_a_top_that_nothing_holds_is_made_smaller(woman: cg.Body):
    wide = rewritten("skirt", woman).scaled(1.6)
    fitted, notes = placement.fit(wide, woman)
    assert any("girth that holds it" in note for note in notes)
    garment = assemble(fitted, COARSE)
    assert garment.vertices[garment.openings[0], 1].mean() > sizes(woman).crotch_height


def test_what_is_tight_at_the_hips_still_hangs_from_them(woman: cg.Body):
    """A straight tube of 88 cm: made wide enough for the hips all the way up it would fall off."""
    sides = {"f": garmentcode.rectangle(44, 40, translation=[0, 80, DEPTH])}
    sides["b"] = garmentcode.rectangle(44, 40, clockwise=True, translation=[0, 80, -DEPTH])
    stitches = [garmentcode.stitch("f", 1, "b", 3), garmentcode.stitch("f", 3, "b", 1)]
    fitted, notes = placement.fit(Pattern.from_json(garmentcode.document(sides, stitches), "tube"), woman)
    assert "of the hips" in notes[0]
    top = opening_lengths(assemble(fitted, COARSE))[0]
    assert 0.88 <= top + 1e-6 <= 0.95 * sizes(woman).hip_girth


def test_legs_end_above_the_ground(woman: cg.Body):
    """A tenth too large: loose at waist and hips, and 9 cm too long."""
    given = rewritten("trousers", woman).scaled(1.12)
    fitted, notes = placement.fit(given, woman)
    assert any("below the feet" in note for note in notes)
    garment = assemble(fitted, COARSE)
    hems = [garment.vertices[garment.openings[n], 1].mean() for n in read(garment).legs.values()]
    assert min(hems) > 0.0


# What counts as worn


def told(expected: str, **crossings: int) -> bool:
    names = ("head", "left_arm", "right_arm", "left_leg", "right_leg")
    return Threading(expected, {name: crossings.get(name, 0) for name in names}).right


def test_openings_for_several_limbs():
    """Limbs are told from where they all begin, in the chest: around the trunk above that, head and arms go through."""
    assert told(LEGS, left_leg=1, right_leg=1)
    assert told(LEGS, head=-1, left_arm=-1, right_arm=-1)
    assert not told(LEGS, head=1), "around the neck"
    assert not told(LEGS, head=1, left_arm=1), "under one arm and over the other"
    assert not told(LEGS), "beside the body"
    border = "head + left_leg + right_leg"
    assert told(border, head=1, left_leg=1, right_leg=1)
    assert not told(border), "an arm of a jacket that nobody wears has nothing to tell it from the others"
    assert not told(border, head=1, left_leg=-1, right_leg=-1)
    assert told("head + right_arm", head=1, right_arm=1)
    assert not told("head + right_arm", head=1)
    assert not told("left_arm", head=1, right_arm=1, left_leg=1, right_leg=1), "one limb goes through by itself"


def test_a_head_looks_out_of_a_hood(woman: cg.Body):
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    face = np.column_stack([0.1 * np.cos(angle), 1.48 + 0.14 * np.sin(angle), np.full(24, 0.2)])
    neck = np.column_stack([0.1 * np.cos(angle), np.full(24, 1.34), 0.1 * np.sin(angle)])
    for ring, looks_out in ((face, True), (neck, False)):
        garment: Any = SimpleNamespace(vertices=ring, openings=(np.arange(24),))
        (head, *others) = paths(garment, ["head"], woman.limbs)
        assert (head.points[-1][2] > 0.9) == looks_out
        assert others == list(woman.limbs[1:])
        assert paths(garment, [LEGS], woman.limbs) == woman.limbs
