"""External inputs added to forces in each interval: `controls` of `step`, `rollout` and `rollout_batch`.

A dictionary by the names that forces have as `control`. Forces of other kinds may read it as they like.
"""

from collections.abc import Mapping
from typing import Any

import jax
from jax import lax

from diffrigid.convert import numbers
from diffrigid.forces import FORCES, Force, Torque
from diffrigid.spelling import nearest


def controlled(forces: tuple, axis: int = 0) -> dict[str, int]:
    """Number of components of each control, by its name.

    Args:
        axis: of the components in the forces: the first, or where a batch comes first the last (-1).
    """
    sizes: dict[str, int] = {}
    for force in forces:
        if isinstance(force, Force | Torque) and force.control is not None:
            size = (force.F if isinstance(force, Force) else force.tau).shape[axis]
            if sizes.setdefault(force.control, size) != size:
                raise ValueError(
                    f"controls: {force.control!r} is the control of a Force and of a Torque, which take unlike "
                    "numbers: give them two names"
                )
    return sizes


def as_controls(
    forces: tuple, controls: Any, dtype: Any, steps: tuple[int, ...], batch: tuple[int, ...] = (), axis: int = 0
) -> Any:
    """Check controls and convert them to arrays of a type.

    Args:
        steps: (T,), or () for one step.
        batch: trailing axes that a control may have; a control without them gets axes of length one.
        axis: as in `controlled`.

    Raises:
        ValueError: one that a force asks for is missing, has no force, or is not of the shape (*steps, D or A).
    """
    sizes = controlled(forces, axis)
    if controls is None and not sizes:
        return None
    given = controls if isinstance(controls, Mapping) else {}
    for name, size in sizes.items():
        if name not in given:
            others = f", but {', '.join(map(repr, given))}" if given else ""
            give = f"give controls={{{name!r}: ...}} of shape {(*steps, size)}"
            raise ValueError(f"controls has no {name!r}{others}: {give}")
    if not isinstance(controls, Mapping) or any(name not in sizes for name in controls):
        if all(isinstance(force, FORCES) for force in forces):
            unused = [name for name in given if name not in sizes] or [controls]
            hint = nearest(str(unused[0]), sizes) if sizes else "give Force or Torque a control"
            raise ValueError(f"controls: no force takes {', '.join(map(repr, unused))}: {hint}")

    whole_controls = [given[name] for name in sizes]  # a list of numbers is one array

    def converted(path: Any, value: Any) -> Any:
        name = getattr(path[0], "key", None) if path else None
        array = lax.convert_element_type(numbers(f"controls[{name!r}]", value, None), dtype)
        whole = (*steps, sizes[name]) if name in sizes else steps
        rest = array.shape[len(whole) :]
        if array.shape[: len(whole)] != whole or (name in sizes and rest not in ((), batch)):
            ending = f" or {(*whole, *batch)}" if batch and name in sizes else ""
            raise ValueError(f"controls[{name!r}] has shape {array.shape}: expected {whole}{ending}")
        return array.reshape(*whole, *[1] * len(batch)) if name in sizes and not rest else array

    def is_whole(node: Any) -> bool:
        return any(node is one for one in whole_controls)

    return jax.tree_util.tree_map_with_path(converted, controls, is_leaf=is_whole)
