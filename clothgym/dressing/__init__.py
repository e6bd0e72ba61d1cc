"""From a 2D pattern and a body to a garment that is worn: place, sew, drape [Vassilev 2001]."""

from clothgym.dressing.draping import Draped, drape

__all__ = ["Draped", "drape"]
