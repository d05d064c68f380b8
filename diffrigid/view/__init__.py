"""Drawing: an inline player, and outlines of shapes."""

from diffrigid.view.outline import outline
from diffrigid.view.play import Player, play

__all__ = ["Player", "outline", "play"]
