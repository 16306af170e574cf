"""Draws architecture.svg: the rooms of the package floor by floor, and three journeys through them.

python docs/images/architecture.py
"""

from __future__ import annotations

from pathlib import Path

# Floors from the roof down, as the layers in pyproject.toml; a room imports only from below.
FLOORS = (
    ("cli",),
    ("bench",),
    ("sources",),
    ("ingest",),
    ("render", "propagation"),
    ("synthesis",),
    ("devices", "fitting"),
    ("calibration",),
    ("relief",),
    ("shapes", "materials"),
    ("metrics", "io"),
    ("sequence", "btf", "queries"),
    ("settings", "footprint", "nearfield", "journal", "labelled"),
    ("textures",),
    ("perceptual",),
    ("jsonvalues", "colour", "directions", "files", "native"),
    ("program",),
    ("conventions",),
    ("errors",),
)
TORCH = {"bench", "propagation", "fitting"}
# How wide a room is beside others on its floor, where not as wide as they.
SHARES = {"sequence": 0.9, "btf": 1.35, "queries": 0.75}
# Rooms that are still to be built.
TO_COME = {"devices", "calibration", "sequence"}
# What, colour, x of its line, stops.
JOURNEYS = (
    (
        "a folder, into the store",
        "#2f6f8f",
        650,
        ("cli", "ingest", "io", "btf", "journal", "files"),
    ),
    ("a BTF, to a model", "#5c7a29", 740, ("cli", "sources", "fitting", "materials")),
    (
        "a query, to the kernel",
        "#b5472f",
        830,
        ("cli", "sources", "materials", "queries", "native"),
    ),
)
WIDTH, LEFT, HEIGHT, GAP, TOP = 900, 60, 34, 12, 20


def rooms() -> dict[str, tuple[float, float, float]]:
    """Name -> left edge, top and width of every room."""
    found = {}
    for floor, names in enumerate(FLOORS):
        shares = [SHARES.get(name, 1.0) for name in names]
        x, room_for = float(LEFT), WIDTH - LEFT - 20 - GAP * (len(names) - 1)
        for name, share in zip(names, shares, strict=True):
            width = room_for * share / sum(shares)
            found[name] = (x, TOP + floor * (HEIGHT + GAP), width)
            x += width + GAP
    return found


def room(name: str, x: float, y: float, width: float) -> str:
    """One room: tinted where torch may be, dashed where nothing stands yet."""
    fill = "#f3e3c3" if name in TORCH else "#f7f5f0"
    dash = ' stroke-dasharray="5 4"' if name in TO_COME else ""
    return (
        f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="{HEIGHT}" rx="4" fill="{fill}" '
        f'stroke="#8a8375"{dash}/>\n'
        f'<text x="{x + 10:.1f}" y="{y + 22}" fill="#2b2925">{name}</text>'
    )


def journey(index: int, places: dict[str, tuple[float, float, float]]) -> str:
    """A line through the rooms of a journey, each stop numbered."""
    _, colour, lane, stops = JOURNEYS[index]
    at = []
    for name in stops:
        x, y, width = places[name]
        if not x + 12 < lane < x + width - 12:
            raise ValueError(f"the line at {lane} misses {name} at {x} to {x + width}")
        at.append((lane, y + HEIGHT / 2))
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
    parts = [
        f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="2.5" '
        f'stroke-linejoin="round" opacity="0.75"/>'
    ]
    for number, (x, y) in enumerate(at, 1):
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="9" fill="{colour}"/>'
            f'<text x="{x:.1f}" y="{y + 4:.1f}" fill="white" font-size="11" '
            f'text-anchor="middle">{number}</text>'
        )
    return "\n".join(parts)


def legend(bottom: float) -> str:
    """What lines and tints mean."""
    parts = []
    for k, (what, colour, *_) in enumerate(JOURNEYS):
        x = LEFT + k * 270
        parts.append(
            f'<circle cx="{x + 9}" cy="{bottom}" r="9" fill="{colour}"/>'
            f'<text x="{x + 26}" y="{bottom + 5}" fill="#2b2925">{what}</text>'
        )
    y = bottom + 30
    parts.append(
        f'<rect x="{LEFT}" y="{y - 11}" width="18" height="18" rx="3" fill="#f3e3c3" '
        f'stroke="#8a8375"/>'
        f'<text x="{LEFT + 26}" y="{y + 3}" fill="#2b2925">may import torch</text>'
        f'<rect x="{LEFT + 270}" y="{y - 11}" width="18" height="18" rx="3" fill="#f7f5f0" '
        f'stroke="#8a8375" stroke-dasharray="5 4"/>'
        f'<text x="{LEFT + 296}" y="{y + 3}" fill="#2b2925">still to be built</text>'
    )
    return "\n".join(parts)


def drawing() -> str:
    """The whole picture."""
    places = rooms()
    bottom = TOP + len(FLOORS) * (HEIGHT + GAP)
    arrow = (
        f'<line x1="30" y1="{TOP + 10}" x2="30" y2="{bottom - 24}" stroke="#8a8375" '
        f'stroke-width="2" marker-end="url(#head)"/>'
        f'<text x="22" y="{(TOP + bottom) / 2}" fill="#6b6558" text-anchor="middle" '
        f'transform="rotate(-90 22 {(TOP + bottom) / 2})">imports point down</text>'
    )
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {bottom + 60}" '
            'font-family="Helvetica, Arial, sans-serif" font-size="14">',
            '<defs><marker id="head" viewBox="0 0 10 10" refX="8" refY="5" markerWidth="7" '
            'markerHeight="7" orient="auto"><path d="M0 0L10 5L0 10z" fill="#8a8375"/>'
            "</marker></defs>",
            '<rect width="100%" height="100%" fill="white"/>',
            arrow,
            *(room(name, *place) for name, place in places.items()),
            *(journey(index, places) for index in range(len(JOURNEYS))),
            legend(bottom + 12),
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".svg").write_text(drawing())
