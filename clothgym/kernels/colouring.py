"""Colours for springs: those of one colour have no vertex in common, so a sweep never waits for the one before."""

from __future__ import annotations

from clothgym._jit import kernel

MOST = 62
"""Colours are bits of an int64."""


@kernel
def colour_springs(ends, used, colours):
    """Gives each spring (S, 2), in order, the least colour that no earlier spring at its ends has; returns their number.

    `used` (V,) int64 zeros, a bit per colour; a spring that finds MOST of them taken gets -1.
    """
    count = 0
    for s in range(ends.shape[0]):
        taken = used[ends[s, 0]] | used[ends[s, 1]]
        colour = 0
        while colour < MOST and (taken >> colour) & 1:
            colour += 1
        if colour == MOST:
            colours[s] = -1
            continue
        used[ends[s, 0]] |= 1 << colour
        used[ends[s, 1]] |= 1 << colour
        colours[s] = colour
        count = max(count, colour + 1)
    return count
