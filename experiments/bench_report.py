"""What `throughput.py` prints and draws."""

import math
from collections import defaultdict

from bench_peers import PEERS, kind

HEADER = (
    "scene   engine          worlds  steps/s   over native batched | compile s  gradient | grad/fwd temp MB | sanity"
)
ROW = "{rate:8.3g} {over_native:13.3g} {over_batched:7.3g} | {compile_s:9.2f} {grad_compile_s:9.2f} | "
ROW += "{grad_over_forward:8.2f} {grad_temp_mb:7.0f} | "
COLUMNS = (
    "scene",
    "diffrigid (worlds)",
    "best native peer",
    "ratio",
    "best batched peer (worlds)",
    "ratio",
    "gradient over forward",
)
TITLES = {
    "S1": "one bouncing disc",
    "S2": "sixteen discs in a box",
    "S3": "ten boxes fall and stand",
    "S4": "a tossed cube",
    "S5": "a chain of five links",
}
COLORS = {"native": "#9aa5b1", "batched": "#d9a441", "diffrigid": "#2a6fb0"}


def title(scene):
    return f"{scene}, {TITLES[scene]}" if scene in TITLES else f"{scene.replace('_', ', ')} discs"


def line(row):
    """Of a case."""
    text = ROW.format_map(defaultdict(lambda: math.nan, row)).replace("nan", "  -")
    text = row.get("error") or text + str(row["sanity"])
    return f"{row['scene']:7} {row['engine']:15} {row['worlds']:6} {text}"


def short(rate):
    """3.2e+05 as 3.2e5."""
    digits, exponent = f"{rate:.1e}".split("e")
    return f"{digits}e{int(exponent)}"


def fastest(rows, key):
    """The row of the highest rate under each key."""
    best = {}
    for row in sorted((row for row in rows if "rate" in row), key=lambda row: row["rate"]):
        best[key(row)] = row
    return best


def summary(rows):
    """In Markdown: the fastest batch of diffrigid beside the fastest peers whose bodies end as they should."""
    right = [row for row in rows if row.get("sanity", {}).get("ok")]
    best = fastest(right, lambda row: (row["scene"], kind(row["engine"])))
    lines = [COLUMNS, ["---"] * len(COLUMNS)]
    for scene in dict.fromkeys(row["scene"] for row in right if row["engine"] == "diffrigid"):
        ours = best[scene, "diffrigid"]
        cells = [title(scene), f"{short(ours['rate'])} ({ours['worlds']})"]
        for of in ("native", "batched"):
            cells += beside(ours, best[scene, of]) if (scene, of) in best else ["-", "-"]
        lines.append(cells + [f"{ours.get('grad_over_forward', math.nan):.1f}".replace("nan", "-")])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def beside(ours, peer):
    worlds = f" ({peer['worlds']})" if kind(peer["engine"]) == "batched" else ""
    ratio = float(f"{ours['rate'] / peer['rate']:.2g}")
    return [f"{peer['engine']} {short(peer['rate'])}{worlds}", f"{ratio:g}"]


def draw(rows, path):
    """The fastest batch of each engine, in all scenes but for crowds of another size."""
    import matplotlib.pyplot as plt

    plt.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "diffrigid", "font.sans-serif": ["DejaVu Sans"]}
    plt.rcParams |= {"font.size": 7, "axes.titlesize": 8}
    best = fastest(rows, lambda row: (row["scene"], row["engine"]))
    scenes = [s for s in dict.fromkeys(row["scene"] for row in rows) if s in (*TITLES, "S6_1024")]
    shape = -(-len(scenes) // 3), min(3, len(scenes))
    size = {"figsize": (3 * shape[1], 1.8 * shape[0] + 0.3), "layout": "constrained"}
    figure, axes = plt.subplots(*shape, **size, squeeze=False, sharex=True)
    for ax, scene in zip(axes.flat, scenes, strict=False):
        shown = [best[scene, engine] for engine in ["diffrigid", *PEERS] if (scene, engine) in best]
        colors = [COLORS[kind(row["engine"])] for row in shown]
        faces = [color if row["sanity"]["ok"] else "none" for row, color in zip(shown, colors, strict=True)]
        bars = ax.barh([row["engine"] for row in shown], [row["rate"] for row in shown], color=faces, edgecolor=colors)
        ax.bar_label(bars, [short(row["rate"]) for row in shown], padding=2)
        ax.set(xscale="log", xlim=(10, 1e10), xticks=[1e2, 1e4, 1e6, 1e8], title=title(scene))
        ax.minorticks_off()
        ax.invert_yaxis()
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(axis="y", length=0)
    figure.supxlabel(
        "world-steps per second on one core; grey: native engines, yellow: batched in JAX; "
        "hollow: bodies do not end as they should"
    )
    figure.savefig(path, metadata={"Date": None})
