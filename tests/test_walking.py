"""A dressed body walks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import clothgym as cg
from clothgym import body as bodies
from clothgym.dressing import walk


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
