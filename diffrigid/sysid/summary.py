"""The part of a fit that is kept: its table, as text, HTML or JSON."""

import json
import platform
import re
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffrigid.catalogue import component
from diffrigid.sysid.orders import Orders
from diffrigid.sysid.table import HEADER, doubts_of, numbers, rows_of, summary_html, summary_text
from diffrigid.tables import lined_up


@dataclass(frozen=True)
class Parameter:
    """One fitted number or vector; with `records` > 0 those of each record, along a first axis."""

    name: str
    value: np.ndarray  # in `unit`
    low: np.ndarray  # 95 % interval, likewise
    high: np.ndarray
    unit: str  # SI, or that of a column; "" where it has none or is unknown
    note: str  # "" or why not to trust it
    records: int = 0

    def __repr__(self) -> str:
        return "\n".join(lined_up(HEADER, rows_of(self)))


@dataclass(frozen=True)
class Summary:
    """The part of a fit that can be written to a file."""

    parameters: tuple[Parameter, ...]
    noise: dict[str, float]  # standard deviation of each column's residuals, in its unit
    costs: np.ndarray  # (starts,) [-] the loss of the residuals, lowest first; inf: diverged
    agree: int  # starts that ended at the best cost
    orders: Orders  # pairs that strike, in order of time, for each of the best 64 starts and of the first three records
    notes: tuple[str, ...]  # what the data cannot tell, and why not to believe the intervals
    seed: int  # of the random starts
    seconds: float  # [s] that the fit took
    versions: dict[str, str]

    def __getitem__(self, name: str) -> Parameter:
        """A parameter by its path, a component by "ball.v[0]", one of several paths that were fitted together, or the
        number of one record as the table has it, "ball.v{1}[0]"."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        if own := re.fullmatch(r"(.+)\{(\d+)\}(.*)", name, re.DOTALL):
            p, k = self[own[1] + own[3]], int(own[2])
            if k < p.records:
                return replace(p, name=name, value=p.value[k], low=p.low[k], high=p.high[k], records=0)
        whole, index = component(name)
        for p in self.parameters:
            if p.name == whole and index is not None and p.value.ndim > bool(p.records) and index < p.value.shape[-1]:
                return _part(p, name, index)
            if name in (parts := p.name.split(" : ")) and len(parts) > 1:
                return _part(p, name, parts.index(name))
            if name in p.name.split(" = "):
                return replace(p, name=name)
        raise KeyError(f"no parameter {name!r}; there are {[p.name for p in self.parameters]}")

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why not to believe any of the numbers, in the first words of such `notes`: "the fit failed", "not converged",
        "the cost jumps", "what was measured is constant", "the steps are too long", "residuals are autocorrelated"; ()
        if there is none."""
        return doubts_of(self)

    def __repr__(self) -> str:
        return summary_text(self)

    def _repr_html_(self) -> str:
        return summary_html(self)

    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table, a dictionary for each number: parameter, value, low, high, unit, note; unrounded."""
        return numbers(self)

    def save(self, path: str | Path) -> Path:
        """Write a JSON file, which `load_fit` reads; numbers that are not finite as "inf" and "nan"."""
        Path(path).write_text(json.dumps(_plain(asdict(self)), indent=1, allow_nan=False) + "\n", encoding="utf-8")
        return Path(path)


def _part(p: Parameter, name: str, index: int) -> Parameter:
    """Component of a vector parameter."""
    return replace(p, name=name, value=p.value[..., index], low=p.low[..., index], high=p.high[..., index])


def _plain(data: Any) -> Any:
    """Convert to the types of JSON."""
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, tuple | list):
        return [_plain(value) for value in data]
    if isinstance(data, np.ndarray | np.generic):
        return _plain(data.tolist())
    return str(data) if isinstance(data, float) and not np.isfinite(data) else data


def load_fit(path: str | Path) -> Summary:
    """Load what `save` wrote: the table, from which `fit(..., resume=...)` continues.

    Raises:
        ValueError: the file is not a saved fit.
        OSError: there is no such file.

    Example:
        >>> saved = dr.load_fit(found.save("fit.json"))  # the table; a fit goes on from it by resume=saved
        >>> bool(saved["restitution"].value == found["restitution"].value)
        True
    """
    content = Path(path).read_bytes()
    try:
        data = json.loads(content)
        parameters = tuple(
            Parameter(**{**p, **{key: np.asarray(p[key], float) for key in ("value", "low", "high")}})
            for p in data.pop("parameters")
        )
        orders = tuple(tuple(tuple(pairs) for pairs in start) for start in data.pop("orders"))
        return Summary(
            parameters=parameters, costs=np.asarray(data.pop("costs"), float), notes=tuple(data.pop("notes")),
            orders=orders, noise={name: float(value) for name, value in data.pop("noise").items()}, **data,
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path} is not a saved fit: {error}") from error


def versions() -> dict[str, str]:
    """Versions of the software that a result depends on."""
    names = {"diffrigid": version("diffrigid"), "jax": jax.__version__, "numpy": np.__version__}
    return names | {"python": platform.python_version(), "dtype": str(jnp.result_type(float))}
