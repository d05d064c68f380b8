"""Where and when the paths of the bodies begin: at the start of the step, or at their latest impact."""

from jax import Array

from diffrigid.flight import Flight, angular_momentum, position, velocity
from diffrigid.pytree import array, pytree
from diffrigid.state import State, rotations


@pytree
class Anchors:
    """Every body at its own time, the start of the step or its latest impact."""

    state: State
    t0: Array = array("N")  # [s]
    since: Array = array("N")  # [s] earliest time for which the path from here holds; before 0: late impacts


def struck(f: Flight, t: Array, q: Array, dv: Array, dL: Array) -> State:
    """State of a body at time t (*batch) [s] of its path, with orientation q, after changes dv [m/s], dL [kg m^2/s]."""
    w = rotations(f.dim).unspin(f.inverse_inertia, q, angular_momentum(f, t) + dL)
    return State(x=position(f, t), q=q, v=velocity(f, t) + dv, w=w)
