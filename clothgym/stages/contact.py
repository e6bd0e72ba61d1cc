"""Substeps in which cloth touches cloth."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.fidelity import Fidelity
from clothgym.kernels import clamped
from clothgym.kernels.integrate import Motion
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.integrate import Step

_SHARINGS = 4
"""Rounds in which clamped layers share their room: as many layers between two walls take part."""


class ContactSubsteps:
    """Substeps with contact: predict, closest points, sweeps with contact last, certificate, new velocities."""

    reads: tuple[str, ...] = ("positions", "velocities", "quads", "apart")
    writes: tuple[str, ...] = ("positions", "velocities")
    parts = ("flat", "predict", "find again", "closest points", "solve", "certify", "advance")
    _ATTEMPTS = 4

    def __init__(
        self, step: Step, candidates: Any, model: ClothModel, fidelity: Fidelity, apart: Any, windy: bool
    ) -> None:
        from clothgym.kernels import certificate, contact, height_field
        from clothgym.response.contact import ContactBuffers

        self.step, self.candidates, self.apart = step, candidates, apart
        self.kernels, self.certify = contact, certificate.certify
        self.contacts = ContactBuffers(max(1024, len(model.faces)))
        self.spare = ContactBuffers(1024)  # looking again must not forget what pressed
        self.near = (
            fidelity.contacts_near_hits == "off_both",
            fidelity.yield_force if fidelity.contacts_near_hits == "yield" else 0.0,
            fidelity.contacts_near_hits == "limited",
        )
        self.rounds = fidelity.repair_rounds
        in_sweeps = step.integrator.in_sweeps
        self.flat_substeps = height_field.xpbd_substeps if candidates.sheets and in_sweeps else None
        self.kept = np.zeros((model.vertex_count if self.flat_substeps else 0, 3))
        self.name = f"contact substeps [{step.label}]"
        if fidelity.untangling == "none" and fidelity.contacts_near_hits == "keep":
            self.reads = ("positions", "velocities", "quads")  # no stage looks for intersections
        if windy:
            self.reads = (*self.reads, "external")
        self.watch = Watch(candidates) if fidelity.continuous else None
        if self.watch:
            self.name = f"{self.name[:-1]}, continuous tests]"
        self.drive: Any = None
        self.pushes = np.zeros((model.vertex_count, 8))
        self.clamped = np.zeros(model.vertex_count, np.bool_)

    def follow(self, drive: Any) -> None:
        """Pinned vertices move as a `stages.drive.Drive` wants."""
        self.drive = drive
        self.flat_substeps = None
        self.reads = (*self.reads, "driven")

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.kernels.solve(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, s.integrator.loose_grips(frame),
            s.integrator.multipliers, substep, s.integrator.in_sweeps,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        """Velocities after contact."""
        contacts, model = self.contacts, frame.model
        self.kernels.stop_rebound(
            frame.state.velocities, model.inverse_masses, contacts.arrays, contacts.active, self.step.dt
        )

    def _flat(self, frame: Frame, motion: Motion) -> int:
        """Substeps in one kernel as long as sheets stay height fields that touch nothing; how many were made."""
        s, state, found = self.step, frame.state, self.candidates
        if self.flat_substeps is None or not found.flat:
            return 0
        frame.count("contacts", 0)
        done, horizon = 0, found.horizon
        while True:
            base = done
            done = self.flat_substeps(
                state.positions, state.velocities, frame.predicted, self.kept, frame.model.arrays, s.radii, motion, s.ground,
                frame.grips, s.integrator.multipliers, done, done + horizon, base, horizon, found.sheets.sheets,
                found.sheets.tube,
            )  # fmt: skip
            if done == s.substeps:
                return done
            # what was left is decided again for as long as it held
            left = s.substeps - done
            horizon = min(done - base, left)
            travel = horizon * s.dt * state.velocities
            if horizon == 0 or not found.settle(state.positions, travel, horizon):
                found.flat, found.horizon = False, 0
                return done
            frame.count("rebuilds", 1)

    def run(self, frame: Frame) -> None:
        s, state, model, found = self.step, frame.state, frame.model, self.candidates
        x, p = state.positions, frame.predicted
        motion = s.motion(frame)
        frame.clamped = 0
        now = time.perf_counter()
        # candidates hold for the substeps base .. base + horizon - 1
        base, horizon = self._flat(frame, motion), found.horizon
        frame.clock(f"{self.name}: flat", now)
        for n in range(base, s.substeps):
            now = time.perf_counter()
            frame.substep = n
            s.integrator.predict(frame, motion)
            if self.drive:
                self.drive.predict(frame, s.dt)
            now = frame.clock(f"{self.name}: predict", now)
            done = n - base
            late = done < horizon and (found.outdated(x, done / horizon) or found.outdated(p, (done + 1) / horizon))
            if late or done >= horizon:
                # what changes its mind is looked at again soon, what kept its course for twice as long
                base, horizon = n, 1 if late else min(max(1, 2 * horizon), s.substeps - n)
                found.expect(x, horizon * (p - x))
                found.gather()
                frame.count("rebuilds", 1)
                now = frame.clock(f"{self.name}: find again", now)
            self.contacts.narrow(x, p, found, self.apart, *self.near)
            frame.count("contacts", self.contacts.active)
            now = frame.clock(f"{self.name}: closest points", now)
            self._solve(frame, motion, n)
            frame.clamped = self._share_room(p)
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
            if self.watch:
                frame.count("tunnel_events", self.watch.events(x, p, all_pairs=found.outdated(p, share)))
            s.integrator.finish(frame, s.dt)
            self._answer(frame)
            frame.clock(f"{self.name}: advance", now)
        frame.clamped += self._between_bodies()
        found.book(frame.count)

    def _share_room(self, p: FloatArray) -> int:
        """Lets clamped vertices keep away from both sides alike; returns how many there are."""
        contacts, active = self.contacts.arrays, self.contacts.active
        found = clamped.between_layers(p, contacts, active, self.pushes, self.clamped)
        for _ in range(_SHARINGS if found else 0):
            clamped.share_room(p, contacts, active, self.clamped, self.pushes)
        return int(found)

    def _between_bodies(self) -> int:
        """Vertices that bodies clamp, beyond those that layers do."""
        return 0


class Watch:
    """Continuous tests of the pairs that the certificate does not cover: beside intersections, and touching ones."""

    def __init__(self, candidates: Any) -> None:
        from clothgym.kernels import continuous

        self.first_times, self.candidates = continuous.first_times, candidates
        self.times = np.zeros(0)

    def events(self, x: FloatArray, p: FloatArray, all_pairs: bool) -> int:
        """How many pairs that were apart at x pass each other on the straight way to p."""
        found = self.candidates
        chosen = slice(None) if all_pairs else found.separation[: found.count, 3] <= 0.0
        quads, kinds = found.quads[: found.count][chosen], found.kinds[: found.count][chosen]
        if len(self.times) < len(quads):
            self.times = np.zeros(int(1.3 * len(quads)))
        times = self.times[: len(quads)]
        self.first_times(x, p - x, quads, kinds, 0.0, times)
        return int(((times > 0.0) & (times <= 1.0)).sum())


class ContactSubstepsOnBody(ContactSubsteps):
    """The same with a body, which has the last word in every sweep."""

    writes = (*ContactSubsteps.writes, "body_forces")

    def __init__(self, step: Step, body: Any, *others: Any) -> None:
        super().__init__(step, *others)
        from clothgym.kernels import body_contact

        self.body_kernels, self.body = body_contact, body
        self.flat_substeps = None
        self.name = f"{self.name[:-1]}, {body.label}]"

    def run(self, frame: Frame) -> None:
        self.contact = self.body.begin(frame)
        super().run(frame)

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.body_kernels.solve_on_body(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, s.integrator.loose_grips(frame),
            s.integrator.multipliers, substep, s.integrator.in_sweeps, self.contact,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        super()._answer(frame)
        self.step.integrator.weigh_pushes(self.contact.moved)
        self.body_kernels.answer_body(frame.state.velocities, frame.model.inverse_masses, self.contact, self.step.dt)

    def _between_bodies(self) -> int:
        return self.body.clamped(self.clamped)
