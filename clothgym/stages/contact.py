"""Substeps in which cloth touches cloth."""

from __future__ import annotations

import time
from typing import Any

from clothgym.fidelity import Fidelity
from clothgym.kernels import integrate
from clothgym.kernels.integrate import Motion
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.integrate import Step


class ContactSubsteps:
    """Substeps with contact: predict, closest points, sweeps with contact last, certificate, new velocities."""

    reads: tuple[str, ...] = ("positions", "velocities", "quads", "apart")
    writes: tuple[str, ...] = ("positions", "velocities")
    parts = ("predict", "find again", "closest points", "solve", "certify", "advance")
    _ATTEMPTS = 4

    def __init__(
        self, step: Step, candidates: Any, model: ClothModel, fidelity: Fidelity, apart: Any, windy: bool
    ) -> None:
        from clothgym.kernels import certificate, contact
        from clothgym.response.contact import ContactBuffers

        self.step, self.candidates, self.apart = step, candidates, apart
        self.kernels, self.certify = contact, certificate.certify
        self.contacts = ContactBuffers(max(1024, len(model.faces)))
        self.spare = ContactBuffers(1024)  # looking again must not forget what pressed
        self.near = (
            fidelity.contacts_near_hits == "off_both",
            fidelity.yield_force if fidelity.contacts_near_hits == "yield" else 0.0,
        )
        self.rounds = fidelity.repair_rounds
        self.name = f"contact substeps [{step.label}]"
        if fidelity.untangling == "none" and fidelity.contacts_near_hits == "keep":
            self.reads = ("positions", "velocities", "quads")  # no stage looks for intersections
        if windy:
            self.reads = (*self.reads, "external")

    def _predict(self, frame: Frame, motion: Motion) -> None:
        self.step.integrator.predict(frame, motion)

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.kernels.solve(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, frame.grips, s.integrator.multipliers, substep,
            s.integrator.in_sweeps,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        """Velocities after contact."""
        contacts, model = self.contacts, frame.model
        self.kernels.stop_rebound(
            frame.state.velocities, model.inverse_masses, contacts.arrays, contacts.active, self.step.dt
        )

    def run(self, frame: Frame) -> None:
        s, state, model, found = self.step, frame.state, frame.model, self.candidates
        x, v, p = state.positions, state.velocities, frame.predicted
        motion = s.motion(frame)
        base, horizon = 0, found.horizon  # candidates hold for the substeps base .. base + horizon - 1
        for n in range(s.substeps):
            now = time.perf_counter()
            self._predict(frame, motion)
            now = frame.clock(f"{self.name}: predict", now)
            done = n - base
            late = done < horizon and (found.outdated(x, done / horizon) or found.outdated(p, (done + 1) / horizon))
            if late or done >= horizon:
                # what changes its mind is looked at again soon, what kept its course for twice as long
                base, horizon = n, 1 if late else min(2 * horizon, s.substeps - n)
                found.expect(x, horizon * (p - x))
                found.gather()
                frame.count("rebuilds", 1)
                now = frame.clock(f"{self.name}: find again", now)
            self.contacts.narrow(x, p, found, self.apart, *self.near)
            frame.count("contacts", self.contacts.active)
            now = frame.clock(f"{self.name}: closest points", now)
            self._solve(frame, motion, n)
            now = frame.clock(f"{self.name}: solve", now)
            share = (n + 1 - base) / horizon
            for _ in range(self._ATTEMPTS):
                if found.outdated(p, share):
                    # something moved further than expected: look again around where everything really goes
                    found.expect(x, p - x)
                    found.gather()
                    self.spare.narrow(x, p, found, self.apart, *self.near)
                    base, horizon, share = n, 1, 1.0
                    frame.count("rebuilds", 1)
                    now = frame.clock(f"{self.name}: find again", now)
                repaired, zoned = self.certify(
                    x, p, model.inverse_masses, model.thickness, found.quads, found.kinds, found.count,
                    found.separation, self.rounds,
                )  # fmt: skip
                frame.count("repaired", repaired)
                frame.count("zoned", zoned)
                now = frame.clock(f"{self.name}: certify", now)
                if not found.outdated(p, share):
                    break
            else:
                frame.count("unproved", 1)
            integrate.finish(x, v, p, s.dt)
            self._answer(frame)
            frame.clock(f"{self.name}: advance", now)


class ContactSubstepsOnBody(ContactSubsteps):
    """The same with a body, which has the last word in every sweep."""

    writes = (*ContactSubsteps.writes, "body_forces")

    def __init__(self, step: Step, body: Any, *others: Any) -> None:
        super().__init__(step, *others)
        from clothgym.kernels import body_contact

        self.body_kernels, self.body = body_contact, body
        self.name = f"{self.name[:-1]}, {body.label}]"

    def run(self, frame: Frame) -> None:
        self.contact = self.body.begin(frame)
        super().run(frame)

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.body_kernels.solve_on_body(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, frame.grips, s.integrator.multipliers, substep,
            s.integrator.in_sweeps, self.contact,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        super()._answer(frame)
        self.body_kernels.answer_body(frame.state.velocities, frame.model.inverse_masses, self.contact, self.step.dt)
