"""Drawing: an inline player, still pictures, and outlines of shapes."""

from diffrigid.view.explore import Explorer, explore
from diffrigid.view.figures import energy, film, momentum, phase, strobe
from diffrigid.view.outline import outline
from diffrigid.view.play import Player, play

__all__ = ["Explorer", "Player", "energy", "explore", "film", "momentum", "outline", "phase", "play", "strobe"]
