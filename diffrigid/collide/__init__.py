"""Contacts between two shapes at given poses: one function per pair of types, in one table.

`COLLIDERS[type_a, type_b]` is a function of one pair,

    contacts(a, x_a, q_a, b, x_b, q_b) -> Contacts

with shapes in their own axes, posed at x (D, *batch), q (Q, *batch). It returns K contacts, K fixed by the
types. To add a pair, add its function here; `scene` reports a pair that is missing.
"""

from collections.abc import Callable

from diffrigid.collide.contacts import Contacts
from diffrigid.collide.convex import convex_convex
from diffrigid.collide.halfspace import box_halfspace, convex_halfspace, round_halfspace
from diffrigid.collide.heights import convex_heights
from diffrigid.collide.pairs import PairGroup, pair_groups
from diffrigid.collide.profile import convex_profile
from diffrigid.collide.round import round_round
from diffrigid.shapes import Box, Capsule, Disc, HalfSpace, HeightField, Hull, Polygon, Profile, Sphere

CONVEX_2D: tuple[type, ...] = (Disc, Capsule, Box, Polygon)
CONVEX_3D: tuple[type, ...] = (Sphere, Capsule, Box, Hull)

COLLIDERS: dict[tuple[type, type], Callable[..., Contacts]] = {
    (a, b): convex_convex for shapes in (CONVEX_2D, CONVEX_3D) for a in shapes for b in shapes
}
COLLIDERS |= {(a, HalfSpace): convex_halfspace for a in CONVEX_2D + CONVEX_3D}
COLLIDERS |= {(a, Profile): convex_profile for a in CONVEX_2D}
COLLIDERS |= {(a, HeightField): convex_heights for a in CONVEX_3D}
COLLIDERS |= {(Disc, Disc): round_round, (Sphere, Sphere): round_round}
COLLIDERS |= {(Disc, HalfSpace): round_halfspace, (Sphere, HalfSpace): round_halfspace}
COLLIDERS[Box, HalfSpace] = box_halfspace

__all__ = ["COLLIDERS", "Contacts", "PairGroup", "pair_groups"]
