"""Models of robots from files: MJCF (MuJoCo) and URDF, as a `World` and a `State`.

file -> links (links.py), each with its pose, mass, shapes and joint -> scene
"""

from diffrigid.models.mjcf import load_mjcf
from diffrigid.models.urdf import load_urdf

__all__ = ["load_mjcf", "load_urdf"]
