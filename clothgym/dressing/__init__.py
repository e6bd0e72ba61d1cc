"""From a 2D pattern and a body to a garment that is worn, and walked in: place, sew, drape [Vassilev 2001]."""

from clothgym.dressing.draping import Draped, drape
from clothgym.dressing.layers import Layered, layer
from clothgym.dressing.playing import play
from clothgym.dressing.walking import Walked, walk

__all__ = ["Draped", "Layered", "Walked", "drape", "layer", "play", "walk"]
