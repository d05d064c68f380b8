"""The kinematic state, the bodies' constants, and what follows from both: energy and momenta.

x is the centre of mass, in the world frame; v and w are in the world frame. Nothing derivable is stored.
"""

import functools
import inspect
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from diffrigid import so2, so3
from diffrigid.pytree import Vector, align, align_all, array, batch_rank, pytree, static

COEFFICIENTS = (  # of colliders; all but the first two may be None
    "restitution",
    "friction",
    "restitution_falloff",
    "rolling_friction",
    "spinning_friction",
)


def rotations(dim: int) -> ModuleType:
    """Module of rotations in `dim` dimensions: so2 or so3."""
    return so2 if dim == 2 else so3


def axis_sizes(dim: int) -> dict[str, int]:
    """Sizes of the axes named D, A and Q: components of a vector, an angular velocity, an orientation."""
    so = rotations(dim)
    return {"D": so.D, "A": so.A, "Q": so.Q}


@pytree
class State:
    """State of N bodies in D dimensions: all that a step changes. A = 1 or 3, Q = 2 or 4 (see so2, so3).

    Example:
        >>> dr.replace(state, w=jnp.array([[5.0]])).q.tolist()  # (cos, sin): unturned
        [[1.0, 0.0]]
    """

    x: Array = array("N", "D")  # (N, D, *batch) [m] centre of mass, world frame
    q: Array = array("N", "Q")  # (N, Q, *batch) [-] orientation, body to world
    v: Array = array("N", "D")  # (N, D, *batch) [m/s] velocity of the centre of mass, world frame
    w: Array = array("N", "A")  # (N, A, *batch) [rad/s] angular velocity, world frame


@pytree
class Bodies:
    """Constants of the moving bodies. Inertia about the centre of mass, in body axes."""

    mass: Array = array("N")  # (N, *batch) [kg]
    inertia: Array = array(lambda b: ("N",) if b.dim == 2 else ("N", "D", "D"))  # [kg m^2]
    restitution: Array = array("N")  # (N, *batch) [-]
    friction: Array = array("N")  # (N, *batch) [-]
    restitution_falloff: Array | None = array("N", default=None)  # (N, *batch) [s/m]; None: constant restitution
    rolling_friction: Array | None = array("N", default=None)  # (N, *batch) [m]; None: none
    spinning_friction: Array | None = array("N", default=None)  # (N, *batch) [m]
    dim: int = static()


@pytree
class Wrench:
    """Force and torque on every body; the torque about the centre of mass. None: no torque at all.

    Example:
        >>> world.forces[0](world.bodies, state, None).F.tolist()  # what a force returns: here gravity
        [[0.0, -9.81]]
    """

    F: Array = array("N", "D")  # (N, D, *batch) [N] world frame
    tau: Array | None = array("N", "A", default=None)  # (N, A, *batch) [N m] world frame


def spin(bodies: Bodies, state: State) -> Array:
    """Angular momentum of each body about its own centre of mass, (N, A, *batch) [kg m^2/s], world frame."""
    return jax.vmap(rotations(bodies.dim).spin)(bodies.inertia, state.q, state.w)


F = TypeVar("F", bound=Callable[..., Array])


def _of_each(of_one: F) -> F:
    """Decorator: `state`, and then the result, may have axes of times and worlds in front, as `rollout` has them."""
    signature = inspect.signature(of_one)

    @functools.wraps(of_one)
    def of_all(*args: object, **named: object) -> Array:
        given = signature.bind(*args, **named).arguments
        _check_kinds(given)
        if "state" not in given or not _times_first(given["state"]):
            return of_one(*args, **named)
        return jax.vmap(lambda state: of_all(**given | {"state": state}))(given["state"])

    return cast(F, of_all)


@_of_each
@jax.jit
def kinetic_energy(bodies: Bodies, state: State) -> Array:
    """Kinetic energy of each body, m v.v / 2 + w.L / 2, (N, *batch) [J]; of states as `rollout` has them (..., N).

    Raises:
        ValueError: a state that is not of these bodies.

    Example:
        >>> energy = dr.kinetic_energy(world.bodies, trajectory.state)  # (T+1, N)
        >>> round(float(energy[-1, 0]), 4)
        3.5348
    """
    bodies, state = _together(bodies, state)
    linear = bodies.mass * (state.v * state.v).sum(1)
    return 0.5 * (linear + (state.w * spin(bodies, state)).sum(1))


@_of_each
@jax.jit
def momentum(bodies: Bodies, state: State) -> Array:
    """Linear momentum of each body, m v, (N, D, *batch) [kg m/s]; of states as `rollout` has them (..., N, D).

    Raises:
        ValueError: a state that is not of these bodies.

    Example:
        >>> dr.momentum(world.bodies, dr.replace(state, v=jnp.array([[2.0, 0.0]]))).tolist()
        [[2.0, 0.0]]
    """
    bodies, state = _together(bodies, state)
    return bodies.mass[:, None] * state.v


@_of_each
@jax.jit
def angular_momentum(bodies: Bodies, state: State) -> Array:
    """Angular momentum of each body about the world origin, x * p + L, (N, A, *batch) [kg m^2/s].

    Of states as `rollout` has them (..., N, A).

    Raises:
        ValueError: a state that is not of these bodies.

    Example:
        >>> dr.angular_momentum(world.bodies, dr.replace(state, v=jnp.array([[2.0, 0.0]]))).tolist()  # no spin: an arm
        [[-2.0]]
    """
    bodies, state = _together(bodies, state)
    orbital = jax.vmap(rotations(bodies.dim).moment)(state.x, momentum(bodies, state))
    return orbital + spin(bodies, state)


def _together(bodies: Bodies, state: State) -> tuple[Bodies, State]:
    """Bodies and a state of them, with the same number of batch axes."""
    _check_sizes(state, bodies.dim, len(bodies.mass))
    return tuple(align_all(bodies, state))


def at_place(x: Array, q: Array, r: Array | None, turn: Array | None) -> tuple[Array, Array]:
    """Where a shape is, and how turned, whose origin is at r on a body at x, turned by `turn`; None: at x, unturned."""
    so = rotations(x.shape[0])
    return x if r is None else x + so.rotate(q, r), q if turn is None else so.compose(q, turn)


def _times_first(state: State) -> bool:
    """Whether the axes of times, or of worlds, come first, as in what `rollout` returns. D, Q and A tell."""
    shapes = [jnp.shape(leaf) for leaf in (state.x, state.q, state.w)]
    sizes = [tuple(axis_sizes(dim)[letter] for letter in "DQA") for dim in (2, 3)]
    own, last = (tuple(shape[axis] for shape in shapes if len(shape) > 2) for axis in (1, -1))
    return last in sizes and own not in sizes


def _check_kinds(given: Mapping[str, object]) -> None:
    """Raise ValueError unless the arguments `bodies` and `state` are such records."""
    for name, kind, source in (("bodies", Bodies, "world.bodies"), ("state", State, "a State, as `scene` makes it")):
        if name in given and not isinstance(given[name], kind):
            raise ValueError(f"{name} is a {type(given[name]).__name__}: expected {source}")


def _check_sizes(state: State, dim: int, count: int) -> None:
    """Raise ValueError for a state that is not that of `count` bodies."""
    sizes = axis_sizes(dim)
    wanted = {name: (count, sizes[letter]) for name, letter in (("x", "D"), ("q", "Q"), ("v", "D"), ("w", "A"))}
    for name, shape in wanted.items():
        if (found := jnp.shape(getattr(state, name)))[:2] != shape:
            raise ValueError(
                f"state.{name} has shape {found}: expected {shape}, and axes of a batch behind, or of times in front"
            )


@_of_each
def material_point(state: State, body: int, point: Vector) -> Array:
    """World position of a point fixed to a body, r = R r_b + x, (D, *batch) [m]; (..., D) of states as `rollout` has.

    Args:
        body: index of the body.
        point: (D, *batch) [m], body axes, from the centre of mass.

    Raises:
        ValueError: no such body, a point of another dimension.

    Example:
        >>> quarter = dr.replace(state, q=jnp.array([[0.0, 1.0]]))
        >>> dr.material_point(quarter, 0, jnp.array([0.1, 0.0])).tolist()
        [0.0, 1.1]
    """
    state, point = _aligned(state, body, point)
    return state.x[body] + rotations(state.x.shape[1]).rotate(state.q[body], point)


@_of_each
def material_velocity(state: State, body: int, point: Vector) -> Array:
    """World velocity of a point fixed to a body, v + w x (R r_b), (D, *batch) [m/s]; (..., D) likewise.

    Args:
        body: index of the body.
        point: (D, *batch) [m], body axes, from the centre of mass.

    Raises:
        ValueError: no such body, a point of another dimension.

    Example:
        >>> spinning = dr.replace(state, w=jnp.array([[5.0]]))
        >>> dr.material_velocity(spinning, 0, jnp.array([0.1, 0.0])).tolist()
        [0.0, 0.5]
    """
    state, point = _aligned(state, body, point)
    so = rotations(state.x.shape[1])
    return state.v[body] + so.cross(state.w[body], so.rotate(state.q[body], point))


def _aligned(state: State, body: int, point: Vector) -> tuple[State, Array]:
    """State and a point (D, *batch) with the same number of batch axes."""
    point, count, dim = jnp.asarray(point), len(state.x), 2 if state.q.shape[1] == 2 else 3
    _check_sizes(state, dim, count)
    if not isinstance(body, jax.core.Tracer) and not (isinstance(body, int | np.integer) and -count <= body < count):
        fix = f"world.names.index({body!r})" if isinstance(body, str) else "as in world.names"
        raise ValueError(f"body is {body!r}: expected the number of a body, from 0 to {count - 1}, {fix}")
    if point.shape[:1] != (dim,):
        raise ValueError(f"point has shape {point.shape}: expected ({dim},), and axes of a batch behind")
    rank = max(batch_rank(state), jnp.ndim(point) - 1)
    return align(state, rank), jnp.reshape(point, jnp.shape(point) + (1,) * (rank + 1 - jnp.ndim(point)))
