"""Substeps in which cloth touches cloth."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from clothgym.arrays import FloatArray
from clothgym.fidelity import Fidelity
from clothgym.kernels.integrate import Motion
from clothgym.model import ClothModel
from clothgym.stages.frame import Frame
from clothgym.stages.integrate import Step
from clothgym.stages.pairs import short_horizon

_WORK = ("contacts", "measured", "repaired", "zoned", "unproved")
"""What `kernels.contact_substeps` counts, in its order."""


_AHEAD = 16
"""Steps for which sheets are decided to be height fields, at most."""
_SHORTER = 3
"""A decision that did not hold to its end is made again for so much less time than it held."""


class ContactSubsteps:
    """Substeps with contact: predict, closest points, sweeps with contact last, certificate, new velocities."""

    reads: tuple[str, ...] = ("positions", "velocities", "quads", "apart")
    writes: tuple[str, ...] = ("positions", "velocities")
    parts = ("flat", "together", "predict", "find again", "closest points", "solve", "certify", "advance")
    in_one_kernel = True
    _ATTEMPTS = 4

    def __init__(
        self, step: Step, candidates: Any, model: ClothModel, fidelity: Fidelity, apart: Any, windy: bool
    ) -> None:
        from clothgym.kernels import certificate, clamped, contact, contact_substeps, height_field
        from clothgym.response.contact import ContactBuffers

        self.step, self.candidates, self.apart = step, candidates, apart
        self.kernels, self.prove, self.settle_clamped = contact, certificate.prove, clamped.settle_clamped
        self.contacts = ContactBuffers(max(1024, len(model.faces)))
        beside = {"yield": fidelity.yield_force, "limited": -1.0}  # see `kernels.contact.narrow`
        self.near = (fidelity.contacts_near_hits == "off_both", beside.get(fidelity.contacts_near_hits, 0.0))
        self.rounds = fidelity.repair_rounds
        self.short = short_horizon(step.substeps)
        in_sweeps = step.integrator.in_sweeps
        self.flat_substeps: Any = height_field.xpbd_substeps if candidates.sheets and in_sweeps else None
        runs = step.integrator.runs if self.flat_substeps else None
        self.course = candidates.sheets.course(runs.arrays.slot, len(runs.arrays.mobility)) if runs else None
        able = self.in_one_kernel and in_sweeps and not fidelity.continuous
        self.together: Any = contact_substeps if able else None
        candidates.ahead = candidates.most_ahead = _AHEAD if self.flat_substeps else 1
        self.kept = np.zeros((model.vertex_count if in_sweeps else 0, 3))
        self.work = np.zeros(len(_WORK), np.int64)
        self.name = f"contact substeps [{step.label}]"
        if fidelity.untangling == "none" and fidelity.contacts_near_hits == "keep":
            self.reads = ("positions", "velocities", "quads")  # no stage looks for intersections
        if windy:
            self.reads = (*self.reads, "external")
        self.watch = Watch(candidates) if fidelity.continuous else None
        if self.watch:
            self.name = f"{self.name[:-1]}, continuous tests]"
        self._clocked = f"{self.name}: flat"
        self.drive: Any = None
        self.pushes = np.zeros((model.vertex_count, 8))
        self.clamped = np.zeros(model.vertex_count, np.bool_)

    def follow(self, drive: Any) -> None:
        """Pinned vertices move as a `stages.drive.Drive` wants."""
        self.drive = drive
        self.flat_substeps = self.together = None
        self.reads = (*self.reads, "driven")

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.kernels.solve(
            frame.state.positions, frame.predicted, model.arrays, self.contacts.arrays, self.contacts.active,
            model.friction, s.radii, motion, s.ground, s.integrator.loose_grips(frame),
            s.integrator.multipliers, substep, s.integrator.in_sweeps, s.integrator.spring_runs,
        )  # fmt: skip

    def _answer(self, frame: Frame) -> None:
        """Velocities after contact."""
        contacts, model = self.contacts, frame.model
        self.kernels.stop_rebound(
            frame.state.velocities, model.inverse_masses, contacts.arrays, contacts.active, self.step.dt
        )

    def _along(self, frame: Frame, motion: Motion, first: int, last: int, base: int, horizon: int) -> int:
        """Substeps `first` up to `last` while sheets keep to a motion that was decided at substep `base` for `horizon` of them;
        returns the one that is left to do."""
        s, state, sheets = self.step, frame.state, self.candidates.sheets
        if self.course is not None:
            return s.integrator.runs.step_along(
                state.positions, state.velocities, s.radii, motion, s.ground, frame.grips, first, last, self.course,
                base, horizon,
            )  # fmt: skip
        return self.flat_substeps(
            state.positions, state.velocities, frame.predicted, self.kept, frame.model.arrays, s.radii, motion, s.ground,
            frame.grips, s.integrator.multipliers, first, last, base, horizon, sheets.sheets, sheets.tube,
            s.integrator.spring_runs,
        )  # fmt: skip

    def _flat(self, frame: Frame, motion: Motion) -> int:
        """Substeps in one kernel as long as sheets stay height fields that touch nothing; how many were made."""
        s, state, found = self.step, frame.state, self.candidates
        if self.flat_substeps is None or not found.flat:
            return 0
        done, base, horizon = 0, -found.spent, found.horizon
        while True:
            done = self._along(frame, motion, done, min(base + horizon, s.substeps), base, horizon)
            if done == s.substeps:
                found.spent = done - base
                return done
            # decided again for a part of the time that it held, since what strays does so ever faster; for the next step, too,
            # if that may be, since a decision costs the same for any time
            held, left = done - base, s.substeps - done
            whole = max(held // (_SHORTER * s.substeps), int(2 * held >= left + s.substeps))
            found.ahead = max(1, whole)
            for horizon in (left + whole * s.substeps, min(held, left)) if whole else (min(held, left),):
                if horizon > 0 and found.settle(state.positions, (horizon * s.dt) * state.velocities, horizon):
                    break
            else:
                found.ahead, found.flat, found.horizon = 1, False, 0
                return done
            base = done
            frame.count("rebuilds", 1)

    def run(self, frame: Frame) -> None:
        motion = self.step.motion(frame)
        frame.clamped = 0
        now = time.perf_counter()
        done = self._flat(frame, motion)
        frame.clock(self._clocked, now)
        if not (frame.settled and done == self.step.substeps):
            self._touch(frame, motion, done)

    def _touch(self, frame: Frame, motion: Motion, n: int) -> None:
        """Substeps from n on in which cloth may touch cloth, and what is left to do after the last."""
        self.contacts.forget()
        frame.count("contacts", 0)
        # candidates hold for the substeps base .. base + horizon - 1
        self.base, self.horizon = n, self.candidates.horizon
        while n < self.step.substeps:
            if self.together is not None and not self.candidates.flat:
                n = self._together(frame, motion, n)
            if n < self.step.substeps:
                self._one(frame, motion, n)
                n += 1
        frame.clamped += self._between_bodies()
        self.candidates.book(frame.count)

    def _together(self, frame: Frame, motion: Motion, first: int) -> int:
        """Substeps in one kernel as long as the candidates are complete; returns the one that is left to do."""
        now = time.perf_counter()
        s, state, model, found, kernels = self.step, frame.state, frame.model, self.candidates, self.together
        last = min(s.substeps, self.base + self.horizon)
        self.work[:] = 0
        done, self.contacts.known, tight = kernels.xpbd_substeps_in_contact(
            state.positions, state.velocities, frame.predicted, self.kept, model.arrays, s.radii, motion, s.ground,
            s.integrator.loose_grips(frame), s.integrator.multipliers, first, last,
            kernels.Expected(found.start, found.travel, found.slack, self.base, self.horizon),
            found.watched, found.count, self.contacts.known, self.contacts.arrays,
            kernels.Rules(model.friction, *self.near, self.rounds, model.thickness, self.apart),
            self.pushes, self.clamped, self.work, s.integrator.spring_runs,
        )  # fmt: skip
        if done > first:
            frame.clamped = int(tight)
            for name, amount in zip(_WORK, self.work.tolist()):
                if amount or name != "unproved":
                    frame.count(name, amount)
        frame.clock(f"{self.name}: together", now)
        return int(done)

    def _find(self, frame: Frame, travel: FloatArray, substep: int, horizon: int) -> None:
        """Candidates anew for vertices that go along `travel` (V, 3) [m] in `horizon` substeps from `substep` on."""
        self.base, self.horizon = substep, horizon
        self.candidates.expect(frame.state.positions, travel)
        self.candidates.gather()
        self.contacts.forget()
        frame.count("rebuilds", 1)

    def _covered(self, frame: Frame, x: FloatArray, share: float) -> bool:
        """Whether no pair is missing with vertices at x (V, 3), at a share of their way; few that strayed are searched for."""
        if not self.candidates.outdated(x, share):
            return True
        if not self.candidates.widen(x, share):
            return False
        self.contacts.forget()
        frame.count("widened", 1)
        return True

    def _one(self, frame: Frame, motion: Motion, n: int) -> None:
        """Substep n, with candidates found anew as often as it takes."""
        s, state, model, found = self.step, frame.state, frame.model, self.candidates
        x, p = state.positions, frame.predicted
        now = time.perf_counter()
        frame.substep = n
        s.integrator.predict(frame, motion)
        if self.drive:
            self.drive.predict(frame, s.dt)
        now = frame.clock(f"{self.name}: predict", now)
        done, horizon = n - self.base, self.horizon
        late = done < horizon and not (
            self._covered(frame, x, done / horizon) and self._covered(frame, p, (done + 1) / horizon)
        )
        if late or done >= horizon:
            # what changes its mind is looked at again soon, what kept its course for twice as long
            horizon = min(self.short if late else max(1, 2 * horizon), s.substeps - n)
            self._find(frame, horizon * (p - x), n, horizon)
            now = frame.clock(f"{self.name}: find again", now)
        measured = self.contacts.narrow(x, p, found, self.apart, *self.near)
        frame.count("contacts", self.contacts.active)
        now = frame.clock(f"{self.name}: closest points", now)
        self._solve(frame, motion, n)
        frame.clamped = int(
            self.settle_clamped(p, self.contacts.arrays, self.contacts.active, self.pushes, self.clamped)
        )
        now = frame.clock(f"{self.name}: solve", now)
        for _ in range(self._ATTEMPTS):
            share = (n + 1 - self.base) / self.horizon
            if not self._covered(frame, p, share):
                # much moved further than expected: look again around where everything really goes
                horizon = min(self.short, s.substeps - n)
                self._find(frame, horizon * (p - x), n, horizon)
                share = 1.0 / horizon
                now = frame.clock(f"{self.name}: find again", now)
            new, repaired, zoned, unproved = self.prove(
                x, p, model.inverse_masses, model.thickness, found.watched, found.count, self.apart, self.near[0],
                self.near[1] == 0.0, self.rounds,
            )  # fmt: skip
            measured += int(new)
            if new:
                self.contacts.forget()
            frame.count("repaired", repaired)
            frame.count("zoned", zoned)
            now = frame.clock(f"{self.name}: certify", now)
            if not found.outdated(p, share):
                break
        else:
            unproved = 1
        frame.count("measured", measured)
        if unproved:
            frame.count("unproved", 1)
        if self.watch:
            frame.count("tunnel_events", self.watch.events(x, p, all_pairs=found.outdated(p, share)))
        s.integrator.finish(frame, s.dt)
        self._answer(frame)
        frame.clock(f"{self.name}: advance", now)

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
        chosen = slice(None) if all_pairs else found.watched.separation[: found.count, 3] <= 0.0
        quads, kinds = found.quads[: found.count][chosen], found.kinds[: found.count][chosen]
        if len(self.times) < len(quads):
            self.times = np.zeros(int(1.3 * len(quads)))
        times = self.times[: len(quads)]
        self.first_times(x, p - x, quads, kinds, 0.0, times)
        return int(((times > 0.0) & (times <= 1.0)).sum())


class ContactSubstepsOnBody(ContactSubsteps):
    """The same with a body, which has the last word in every sweep."""

    writes = (*ContactSubsteps.writes, "body_forces")

    def __init__(self, step: Step, body: Any, candidates: Any, *others: Any) -> None:
        super().__init__(step, candidates, *others)
        from clothgym.kernels import body_contact

        self.body_kernels, self.body = body_contact, body
        self.flat_substeps = self.together = None
        candidates.ahead = candidates.most_ahead = 1
        self.name = f"{self.name[:-1]}, {body.label}]"
        self._clocked = f"{self.name}: flat"

    def run(self, frame: Frame) -> None:
        self.body.begin(frame)
        super().run(frame)

    def _solve(self, frame: Frame, motion: Motion, substep: int) -> None:
        s, model = self.step, frame.model
        self.contact = self.body.look(frame, motion.dt)
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
