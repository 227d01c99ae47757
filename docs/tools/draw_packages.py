"""Draws which packages import which, by the sources: `python docs/tools/draw_packages.py` writes docs/packages.svg.

An arrow points from a package to one that it imports; every import counts, in functions and for types alike. An arrow
that follows from others is left out. Where packages import each other in a circle, the arrow with the fewest imports is
the one against the order, and is drawn in red.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from html import escape
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, PICTURE = ROOT / "omniperception", ROOT / "docs" / "packages.svg"
Edge = tuple[str, str]
ROLES = {
    "avoidance": "risk of velocities, V_avoid",
    "build": "run: env, networks, runner",
    "commands": "one module for each command",
    "common": "random streams, rotations",
    "config": "presets and overrides to text",
    "deploy": "export, simulated robot",
    "env": "step, state, sensing, mdp terms",
    "evaluation": "trials, baselines, tables, films",
    "gym": "Gymnasium environments",
    "learning": "actor, PPO, storage, runner",
    "perception": "samplers and networks",
    "plan": "what a run consists of",
    "publish": "a run for others to have",
    "robots": "presets from robots' files",
    "scene": "robot, terrain, obstacles",
    "schema": "text to checked objects",
    "sim": "MuJoCo, MuJoCo Warp, planar",
    "training": "a training from begin to end",
    "viewer": "a task live in the browser",
}
"""What a box says; `packages` has to find exactly these."""
BOX, GAP, ROW, MARGIN, SLOT = (196, 46), 22, 80, 20, 16
"""Width and height of a box, space between two, height of a row, margin, width that a passing arrow gets; pixels."""
FORTH, BACK = "#7c8aa0", "#c0392b"


def packages(root: Path = PACKAGE) -> list[str]:
    """Packages and modules at the top of a package, by name."""
    return sorted(
        path.stem
        for path in root.iterdir()
        if (path / "__init__.py").is_file() or (path.suffix == ".py" and not path.stem.startswith("__"))
    )


def imports(root: Path = PACKAGE) -> dict[Edge, int]:
    """How often the sources of a package at the top import another one."""
    names, found = set(packages(root)), dict[Edge, int]()
    for path in sorted(root.rglob("*.py")):
        owner = path.relative_to(root).with_suffix("").parts[0]
        for module in _imported(ast.parse(path.read_text()), path.relative_to(root.parent).parts[:-1]):
            target = f"{module}..".split(".")[1]
            if module.startswith(f"{root.name}.") and target in names and owner in names - {target}:
                found[owner, target] = found.get((owner, target), 0) + 1
    return found


def _imported(tree: ast.AST, package: tuple[str, ...]) -> Iterator[str]:
    """Full names of the modules that a file of a package imports, or of what it takes from them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else ()
            module = ".".join((*above, *filter(None, [node.module])))
            yield from (f"{module}.{alias.name}" for alias in node.names)


def against_the_order(weights: dict[Edge, int]) -> set[Edge]:
    """The lightest edges whose removal leaves no circle, chosen one by one."""
    edges, removed = set(weights), set[Edge]()
    while True:
        reach = _reach(edges)
        circular = [(a, b) for a, b in edges if a in reach[b]]
        if not circular:
            return removed
        lightest = min(circular, key=lambda edge: (weights[edge], edge))
        edges.remove(lightest)
        removed.add(lightest)


def _reach(edges: set[Edge]) -> dict[str, set[str]]:
    """Everything that each node leads to."""
    reach = {node: {b for a, b in edges if a == node} for edge in edges for node in edge}
    grown = True
    while grown:
        before = {node: len(found) for node, found in reach.items()}
        for found in reach.values():
            found.update(*(reach[node] for node in list(found)))
        grown = any(len(found) > before[node] for node, found in reach.items())
    return reach


def shown(edges: set[Edge]) -> set[Edge]:
    """The edges of a graph without circles that do not follow from others."""
    reach = _reach(edges)
    return {(a, b) for a, b in edges if not any(b in reach[c] for a2, c in edges if a2 == a and c != b)}


def rows(edges: set[Edge], names: list[str]) -> list[list[str]]:
    """Nodes by the length of their longest way down, the highest first."""
    depth: dict[str, int] = {}

    def of(node: str) -> int:
        if node not in depth:
            depth[node] = max((of(b) + 1 for a, b in edges if a == node), default=0)
        return depth[node]

    highest = max(map(of, names))
    return [[node for node in names if of(node) == level] for level in range(highest, -1, -1)]


def laid_out(levels: list[list[str]], edges: set[Edge]) -> tuple[dict[str, float], dict[Edge, list[str]]]:
    """Middles (pixels) of boxes and of the places at which arrows pass rows; each arrow's way from box to box.

    An arrow over one row goes between its boxes, which are ordered so that neighbours are near; a longer one beside.
    """
    level = {node: k for k, row in enumerate(levels) for node in row}
    ways, grid, long = dict[Edge, list[str]](), [list(row) for row in levels], list[list[str]]()
    for a, b in sorted(edges, key=lambda edge: (level[edge[1]] - level[edge[0]], edge)):
        passed = [f"{a}>{b}@{k}" for k in range(level[a] + 1, level[b])]
        if len(passed) == 1:
            grid[level[a] + 1].append(passed[0])
        elif passed:
            long.append(passed)
        ways[a, b] = [a, *passed, b]
    links = sorted({pair for way in ways.values() if len(way) < 4 for pair in pairwise(way)})
    for sweep in range(24):
        x = {node: at for row in grid for node, at in _places(row).items()}
        to, of = (0, 1) if sweep % 2 == 0 else (1, 0)
        for row in grid:
            near = {node: [x[link[to]] for link in links if link[of] == node] or [x[node]] for node in row}
            row.sort(key=lambda node: (sum(near[node]) / len(near[node]), node))
    x = {node: at for row in grid for node, at in _places(row).items()}
    edge_of = [max((x[node] for node in row), default=0.0) + BOX[0] / 2 for row in grid]
    for passed in long:
        rows_passed = [int(slot.partition("@")[2]) for slot in passed]
        lane = max(edge_of[k] for k in rows_passed) + GAP
        for k, slot in zip(rows_passed, passed, strict=True):
            x[slot], edge_of[k] = lane, lane
    return x, ways


def _places(row: list[str]) -> dict[str, float]:
    """Middles (pixels) of boxes and passing arrows beside each other, around 0."""
    widths = [SLOT if "@" in node else BOX[0] for node in row]
    left, places = -(sum(widths) + GAP * (len(row) - 1)) / 2, {}
    for node, width in zip(row, widths, strict=True):
        places[node] = left + width / 2
        left += width + GAP
    return places


def picture(weights: dict[Edge, int], names: list[str]) -> str:
    """An SVG of packages and imports."""
    back = against_the_order(weights)
    levels = rows(set(weights) - back, names)
    x, ways = laid_out(levels, shown(set(weights) - back))
    y = {node: MARGIN + ROW * k for k, row in enumerate(levels) for node in row}
    y |= {slot: MARGIN + ROW * int(slot.partition("@")[2]) for slot in x if "@" in slot}
    left = min(x.values()) - BOX[0] / 2 - 3 * MARGIN
    x = {node: at - left for node, at in x.items()}
    width, height = max(x.values()) + BOX[0] / 2 + MARGIN, MARGIN + max(y.values()) + BOX[1]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}"'
        f' font-family="Helvetica, Arial, sans-serif"><defs>{_tip("forth", FORTH)}{_tip("back", BACK)}</defs>',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
    ]
    for (a, b), way in sorted(ways.items()):
        parts.append(_arrow(_down([(x[node], y[node]) for node in way]), "forth", FORTH, f"{a} imports {b}"))
    for a, b in sorted(back):
        side = -1 if x[b] == min(x[node] for node in levels[y[b] // ROW]) else 1
        between = max(side * x[node] for node in names if y[b] <= y[node] <= y[a])
        beside = side * (between + BOX[0] / 2 + GAP * (y[a] - y[b]) / ROW)
        parts.append(_arrow(_up(x, y, (a, b), side, beside), "back", BACK, f"{a} imports {b}"))
    parts += [_box(name, x[name], y[name]) for name in names]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _box(name: str, middle: float, top: int) -> str:
    """A package and what it is for."""
    place, left = f'x="{middle:.0f}" text-anchor="middle"', middle - BOX[0] / 2
    return (
        f'<rect x="{left:.0f}" y="{top}" width="{BOX[0]}" height="{BOX[1]}" rx="7" fill="#eef3fa" stroke="#33507a"/>'
        f'<text {place} y="{top + 19}" font-size="15" font-weight="bold" fill="#1d2b42">{name}</text>'
        f'<text {place} y="{top + 36}" font-size="11.5" fill="#41506a">{escape(ROLES[name])}</text>'
    )


def _tip(name: str, colour: str) -> str:
    """The head of an arrow."""
    size = 'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto"'
    return f'<marker id="{name}" {size}><path d="M0,0 L8,4 L0,8 z" fill="{colour}"/></marker>'


def _arrow(path: str, kind: str, colour: str, title: str) -> str:
    dashes = "" if kind == "forth" else ' stroke-dasharray="5 3"'
    style = f'fill="none" stroke="{colour}" stroke-width="1.5"{dashes} marker-end="url(#{kind})"'
    return f'<path d="{path}" {style}><title>{title}</title></path>'


def _down(points: list[tuple[float, float]]) -> str:
    """Out of the bottom of the first box, through the places that it passes, into the top of the last one."""
    (x, y), *others = points
    path = f"M{x:.0f},{y + BOX[1]}"
    for to_x, to_y in others:
        start = y + BOX[1]
        bend = (to_y - start) / 2
        path += f" L{x:.0f},{start} C{x:.0f},{start + bend:.0f} {to_x:.0f},{to_y - bend:.0f} {to_x:.0f},{to_y}"
        x, y = to_x, to_y
    return path


def _up(x: dict[str, float], y: dict[str, int], edge: Edge, side: int, beside: float) -> str:
    """Out of the left (-1) or right (1) side of a box, past `beside` (pixels), into that side of another one."""
    (a_x, a_y), (b_x, b_y) = ((x[node] + side * BOX[0] / 2, y[node] + BOX[1] / 2) for node in edge)
    half = (a_y - b_y) / 2
    return (
        f"M{a_x:.0f},{a_y:.0f} C{beside:.0f},{a_y:.0f} {beside:.0f},{a_y - half / 2:.0f} {beside:.0f},{a_y - half:.0f}"
        f" S{beside:.0f},{b_y:.0f} {b_x:.0f},{b_y:.0f}"
    )


if __name__ == "__main__":
    found = packages()
    if missing := set(found) ^ set(ROLES):
        raise SystemExit(f"{', '.join(sorted(missing))}: correct ROLES in {Path(__file__).relative_to(ROOT)}")
    PICTURE.write_text(picture(imports(), found))
    print(f"wrote {PICTURE.relative_to(ROOT)}")
