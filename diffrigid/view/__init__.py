"""Drawing: outlines of shapes."""

from diffrigid.view.outline import outline

__all__ = ["outline"]
