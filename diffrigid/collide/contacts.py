"""The record that every pair function returns."""

from jax import Array

from diffrigid.pytree import array, pytree

ALERT = 4e-3  # [-] of the size: least gap of a feature that may be met within the step; above `NEAR` of the search
FAR = 1e6  # [m] gap of features that cannot meet, and reach of unbounded shapes
THERE = 0.5 * FAR  # [m] contacts with a smaller gap exist


@pytree
class Contacts:
    """K contacts of one pair of shapes a and b, world frame."""

    gap: Array = array("K")  # (K, *batch) [m] signed distance, negative in penetration
    normal: Array = array("K", "D")  # (K, D, *batch) [-] unit, from b to a
    point: Array = array("K", "D")  # (K, D, *batch) [m] midway between the two surfaces
