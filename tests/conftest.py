"""Fixtures that several test files share."""

from __future__ import annotations

import pytest
from command_cases import commands, say  # noqa: F401
from fake_benchmark import bench, fake, plugin  # noqa: F401


@pytest.fixture
def substeps(monkeypatch):
    """A list that collects (x, p), where every substep with contact starts and ends, while a simulation runs."""
    from clothgym.kernels import integrate
    from clothgym.stages.contact import ContactSubsteps

    recorded = []
    finish = integrate.finish

    def recording(x, v, p, dt):
        recorded.append((x.copy(), p.copy()))
        finish(x, v, p, dt)

    monkeypatch.setattr(integrate, "finish", recording)
    monkeypatch.setattr(ContactSubsteps, "in_one_kernel", False)  # nothing can be seen in there
    return recorded
