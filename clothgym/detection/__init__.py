"""Which primitives may touch (candidates) and which do (hits, proximities, contours)."""
