"""Numbers under a line of names, from a file."""

import csv
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from diffrigid.spelling import nearest


def read_csv(
    path: str | Path, left_out: Collection[str] = (), only: Mapping[str, str] | None = None
) -> dict[str, np.ndarray]:
    """Read the columns of a file with one line of names, as `fit` does; an empty cell is a missing value.

    Between columns are commas, or semicolons or tabs where the names have these; numbers may then have decimal commas.

    Args:
        left_out: names of columns that may hold anything.
        only: names of the columns that are read, and what they are for, for messages; None: all.

    Raises:
        ValueError: what is not numbers under one line of names.
        OSError: there is no such file.

    Example:
        >>> Path("drop.csv").write_text("time;height_mm\\n0,5;1250,0\\n0,6;1193,5\\n") > 0
        True
        >>> table = dr.read_csv("drop.csv")
        >>> {"t": table["time"], "ball.x[1]": 1e-3 * table["height_mm"]}["ball.x[1]"].tolist()
        [1.25, 1.1935]
    """
    try:
        with open(Path(path), newline="", encoding="utf-8-sig") as file:  # a number would be an open file
            lines = {n: line for n, line in enumerate(file, 1) if line.strip() and not line.startswith("#")}
        numbers, texts = list(lines), list(lines.values())
        mark = next((mark for mark in ";\t" if texts and mark in texts[0]), ",")
        reader = csv.reader(texts, delimiter=mark)
        rows = [(numbers[reader.line_num - 1], row) for row in reader]
    except UnicodeEncodeError:
        raise ValueError(f"{str(path)!r} cannot be the name of a file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} is not a CSV file: {error}") from None
    if not rows:
        raise ValueError(f"{path} is empty: expected a line of names, and numbers under it")
    names, body = [name.strip() for name in rows[0][1]], [row for _, row in rows[1:]]
    for name, use in (only or {}).items():
        if name not in names:
            raise ValueError(f"{path} has no column {name!r}, which is {use!r} here: {nearest(name, names)}")
    kept = [k for k, name in enumerate(names) if name not in left_out and (only is None or name in only)]
    if twice := [names[k] for k in kept if names[k] in names[:k]]:
        raise ValueError(f"{path}: two columns have the name {twice[0]!r}: rename one, or leave it out")
    for number, row in rows[1:]:
        if len(row) != len(names):
            raise ValueError(f"{path}, line {number}: {len(row)} cells, expected {len(names)}, one for each name")
        for k in kept:
            cell = row[k].replace(",", ".") if mark != "," else row[k]
            if cell.strip() and not is_number(cell):
                raise ValueError(
                    f"{path}, line {number}, column {names[k]!r} is {row[k]!r}: expected numbers under one line of "
                    "names, empty where missing"
                )
    if mark != ",":
        body = [[cell.replace(",", ".") for cell in row] for row in body]
    cells = np.array([[float(row[k]) if row[k].strip() else np.nan for k in kept] for row in body])
    return {names[k]: cells[:, j] if len(body) else np.zeros(0) for j, k in enumerate(kept)}


def is_number(cell: str) -> bool:
    """Whether the text of a cell is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # which Python takes
