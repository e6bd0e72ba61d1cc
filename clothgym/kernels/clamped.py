"""Vertices that are pressed from opposite sides harder than they can give way: cloth clamped between layers or body parts."""

from __future__ import annotations

import math

from clothgym._jit import bare, kernel

_TIGHT = 0.5
"""Share of the thickness below which a pressed contact counts as tight."""

_SHARINGS = 4
"""Rounds in which clamped layers share their room: as many layers between two walls take part."""

_BALANCED = 0.5
"""Pushes from opposite sides: their sum is a smaller share of their sizes than this."""


@bare
def _between_layers(p, contacts, count, push, clamped):
    """Marks vertices, clamped (V,), that tight contacts press from opposite sides at the end of a substep; returns how many.

    p (V, 3): positions after the sweeps; contacts: of which `count` are live; push (V, 4) or wider is scratch.

    A contact is tight where the sweeps could not keep half its thickness. In a pile at rest every layer is pressed from both
    sides too, but none is tight.
    """
    push[:] = 0.0
    clamped[:] = False
    for m in range(count):
        n = contacts.live[m]
        if contacts.pressed[n] <= 0.0 or contacts.limit[n] < math.inf:
            continue  # beside an intersection, contact gives way
        gap = 0.0
        for k in range(4):
            v = contacts.quads[n, k]
            for c in range(3):
                gap += contacts.weights[n, k] * contacts.normals[n, c] * p[v, c]
        tight = gap < _TIGHT * contacts.rest[n]
        for k in range(4):
            v = contacts.quads[n, k]
            force = contacts.pressed[n] * contacts.weights[n, k]
            for c in range(3):
                push[v, c] += force * contacts.normals[n, c]
            push[v, 3] += abs(force)
            clamped[v] = clamped[v] or (tight and force != 0.0)
    found = 0
    for v in range(p.shape[0]):
        clamped[v] = clamped[v] and _is_balanced(push[v, 0], push[v, 1], push[v, 2], push[v, 3])
        found += clamped[v]
    return found


@bare
def _share_room(p, contacts, count, clamped, push):
    """Moves each clamped vertex into the middle of what presses it, so that no side takes all the room there is.

    A sweep satisfies the last contact at the cost of the one before, and within some substeps one side would be pressed to
    nothing. Of all contacts of a vertex the one that lacks most, and the one across from it that lacks most, share what both
    lack; p (V, 3) changes at vertices in clamped (V,); push (V, 8) is scratch.
    """
    push[:] = 0.0
    for turn in range(2):
        for m in range(count):
            n = contacts.live[m]
            if contacts.pressed[n] <= 0.0 or contacts.limit[n] < math.inf:
                continue
            lack = contacts.rest[n]
            share = 0.0
            for k in range(4):
                v = contacts.quads[n, k]
                w = contacts.weights[n, k]
                share += w * w if clamped[v] else 0.0
                for c in range(3):
                    lack -= w * contacts.normals[n, c] * p[v, c]
            if share == 0.0 or lack <= 0.0:
                continue
            for k in range(4):
                v = contacts.quads[n, k]
                if not clamped[v]:
                    continue
                # a corner that hardly takes part must not be thrown out for the others
                amount = min(max(lack * contacts.weights[n, k] / share, -lack), lack)
                size = abs(amount)
                if turn == 1:
                    along = 0.0
                    for c in range(3):
                        along += amount * contacts.normals[n, c] * push[v, c]
                    if along >= 0.0:
                        continue
                at = 4 * turn
                if size > push[v, at + 3]:
                    for c in range(3):
                        push[v, at + c] = amount * contacts.normals[n, c]
                    push[v, at + 3] = size
    for v in range(p.shape[0]):
        if clamped[v]:
            for c in range(3):
                p[v, c] += 0.5 * (push[v, c] + push[v, 4 + c])


@bare
def _any_tight(p, contacts, count):
    quads = contacts.quads
    weights = contacts.weights
    normals = contacts.normals
    pressed = contacts.pressed
    limit = contacts.limit
    rest = contacts.rest
    live = contacts.live
    for m in range(count):
        n = live[m]
        if pressed[n] <= 0.0 or limit[n] < math.inf:
            continue
        gap = 0.0
        for k in range(4):
            v = quads[n, k]
            along = normals[n, 0] * p[v, 0] + normals[n, 1] * p[v, 1] + normals[n, 2] * p[v, 2]
            gap += weights[n, k] * along
        if not gap >= _TIGHT * rest[n]:
            return True
    return False


@bare
def settle(p, contacts, count, push, clamped):
    """See `settle_clamped`."""
    if not _any_tight(p, contacts, count):
        clamped[:] = False
        return 0
    found = _between_layers(p, contacts, count, push, clamped)
    for _ in range(_SHARINGS if found > 0 else 0):
        _share_room(p, contacts, count, clamped, push)
    return found


@kernel
def settle_clamped(p, contacts, count, push, clamped):
    """Lets vertices that layers clamp, clamped (V,), keep away from both sides alike; returns how many there are.

    p (V, 3): positions after the sweeps, changed at clamped vertices; contacts: of which `count` are live; push (V, 8) is
    scratch.
    """
    return settle(p, contacts, count, push, clamped)


@kernel
def between_bodies(squeeze, least, clamped):
    """Marks vertices, clamped (V,), that bodies have pushed to and fro by more than `least` [m] within a step; returns how
    many were not marked before. squeeze (V, 4): see `body_contact.BodyContact`; one substep may feel one side only."""
    found = 0
    for v in range(squeeze.shape[0]):
        if clamped[v]:
            continue
        clamped[v] = squeeze[v, 3] > least and _is_balanced(squeeze[v, 0], squeeze[v, 1], squeeze[v, 2], squeeze[v, 3])
        found += clamped[v]
    return found


@bare
def _is_balanced(x, y, z, size):
    return size > 0.0 and math.sqrt(x * x + y * y + z * z) < _BALANCED * size
