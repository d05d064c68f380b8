"""Which shapes can meet: candidate pairs, grouped by the pair of types, found once when a scene is made."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PairGroup:
    """P pairs of one kind; on each side all colliders move, or none does.

    Shape a of pair p is row `row_a[p]` of `world.shapes[shape_a]`, on collider `a[p]`; b likewise.
    """

    shape_a: int
    shape_b: int
    row_a: tuple[int, ...]
    row_b: tuple[int, ...]
    a: tuple[int, ...]
    b: tuple[int, ...]
    count: int  # contacts of each pair, K


def pair_groups(kinds, owners, moving: int, ignore, table, count) -> tuple[PairGroup, ...]:
    """All pairs of shapes of which at least one moves, as groups.

    Args:
        kinds: type of each entry of `world.shapes`.
        owners: for each entry, the collider of each of its rows; bodies are 0 .. moving-1, then statics.
        ignore: set of frozensets of two colliders that pass through each other.
        table: mapping whose keys (type_a, type_b) say which orders exist.
        count: function of the indices of two entries of `world.shapes`: contacts of such a pair.

    Raises:
        ValueError: two shapes that can meet have no entry in the table, in either order.
    """
    found: dict[tuple, list[tuple[int, int, int, int]]] = {}
    rows = [(g, r, owner) for g, group in enumerate(owners) for r, owner in enumerate(group)]
    rows.sort(key=lambda row: row[2])
    for i, first in enumerate(rows):
        for second in rows[i + 1 :]:
            if first[2] >= moving or first[2] == second[2] or frozenset((first[2], second[2])) in ignore:
                continue
            a, b = _ordered(first, second, kinds, table)
            key = (a[0], b[0], a[2] < moving, b[2] < moving)  # statics form groups of their own
            found.setdefault(key, []).append((a[1], b[1], a[2], b[2]))
    groups = []
    for (shape_a, shape_b, *_), pairs in found.items():
        row_a, row_b, a, b = zip(*pairs, strict=True)
        groups.append(PairGroup(shape_a, shape_b, row_a, row_b, a, b, count(shape_a, shape_b)))
    return tuple(groups)


def _ordered(first, second, kinds, table):
    first, second = sorted((first, second))  # one order for each pair of kinds: fewer groups, smaller programs
    for a, b in ((first, second), (second, first)):
        if (kinds[a[0]], kinds[b[0]]) in table:
            return a, b
    names = kinds[first[0]].__name__, kinds[second[0]].__name__
    raise ValueError(
        f"no collision function for {names[0]} with {names[1]}; there are "
        f"{sorted(f'{a.__name__}-{b.__name__}' for a, b in table)}: "
        "use another shape, or name the two bodies in `ignore`"
    )
