"""Procedural materials with known relief and reflectance. Everything here is synthetic.

Each function makes one tile: `size` texels square, `relief_texels` the height of its structure in
texels of that tile. The photographs behind brick, grass and gravel are scikit-image's (CC0); the
relief read into their brightness is invented, not measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import Wrap
from btfkit.errors import unknown
from btfkit.relief.relief import Relief

Floats = NDArray[np.floating]
# Texels a side, height of the structure in tile widths, randomness -> one tile.
Maker = Callable[[int, float, np.random.Generator], Relief]


def make(
    name: str,
    size: int = 128,
    *,
    relief_texels: float | None = None,
    seed: int = 0,
    wrap: Wrap = "wrap",
) -> Relief:
    """A material of the catalogue.

    Args:
        name: a name of `CATALOGUE`.
        size: texels a side.
        relief_texels: height of its structure, texels; None takes its own default.
        seed: of what is random in it.
        wrap: "wrap" for a tile; "clamp" for a sample that does not tile, cut from a larger one.

    Raises:
        ValueError: no such material, or a size without structure.
    """
    if name not in CATALOGUE:
        raise ValueError(unknown("material", name, CATALOGUE))
    if size < 8:
        raise ValueError(f"size = {size}; expected at least 8 texels")
    function, default = CATALOGUE[name]
    texels = default if relief_texels is None else relief_texels
    if wrap == "wrap":
        made = function(size, texels / size, np.random.default_rng(seed))
    else:
        made = _corner(_larger(function, size, texels, seed), size)
    recipe = {"name": name, "size": size, "relief_texels": texels, "seed": seed, "wrap": wrap}
    return replace(made, provenance={**made.provenance, RECIPE: recipe})


# Key of a provenance under which `make` leaves its own arguments.
RECIPE = "procedural"


def described() -> dict[str, str]:
    """One line about each material."""
    return {name: (made.__doc__ or "").split("\n")[0] for name, (made, _) in CATALOGUE.items()}


# How much larger the tile is that a sample is cut from: no structure repeats in such a part of it.
_LARGER = 1.37


def _larger(function: Maker, size: int, texels: float, seed: int) -> Relief:
    n = round(size * _LARGER)
    return function(n, texels / n, np.random.default_rng(seed))


def _corner(tile: Relief, size: int) -> Relief:
    def cut(values: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        return None if values is None else values[:size, :size]

    height = tile.height[:size, :size] * np.float32(tile.size[1] / size)
    return replace(
        tile, height=height, albedo=tile.albedo[:size, :size], specular=tile.specular[:size, :size],
        roughness=tile.roughness[:size, :size], roughness_across=cut(tile.roughness_across),
        tangent=cut(tile.tangent), opacity=cut(tile.opacity), wrap="clamp",
    )  # fmt: skip


def cobbles(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """Rounded stones, each with a colour and a gloss of its own, in sand."""
    count = 6
    cells = (np.indices((count, count)).reshape(2, -1).T + 0.5) / count
    seeds = (cells + rng.uniform(-0.32, 0.32, cells.shape) / count) % 1
    first, second, nearest = _voronoi(size, seeds)
    edge = np.clip((second - first) * count * 1.2, 0, 1)
    dome = np.sqrt(np.clip(1 - (1 - edge) ** 2, 0, 1))
    tilt = rng.normal(0, 0.15, count * count)[nearest]
    height = depth * dome * (0.85 + tilt) + 0.03 * depth * _noise(size, 16, rng)
    stone = _smooth(edge, 0.12, 0.3)
    sandstone, granite = np.array([1.0, 0.84, 0.66]), np.array([0.84, 0.9, 1.0])
    bright, warm = rng.uniform(0.16, 0.6, (count**2, 1)), rng.uniform(0, 1, (count**2, 1))
    tint = (bright * _mix(granite, sandstone, warm))[nearest]
    grain = 1 + 0.18 * _noise(size, 24, rng)[..., None]
    sand = np.array([0.36, 0.3, 0.22]) * (1 + 0.25 * _noise(size, 40, rng)[..., None])
    albedo = _mix(sand, tint * grain, stone[..., None])
    rough = rng.uniform(0.25, 0.6, count * count)[nearest]
    return _relief("cobbles", height, albedo, 0.04, _mix(0.9, rough, stone))


def woven(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """Twill of two colours; yarns pass over and under, and shine along their fibres."""
    yarns = max(8, size // 16 // 4 * 4)
    v, u = _grid(size)
    warp, weft = u * yarns, v * yarns
    column, row = np.floor(warp).astype(int), np.floor(weft).astype(int)
    over = (column + row) % 4 < 2  # warp over two, under two: a twill line of 45 degrees
    profiles = [np.sqrt(np.clip(1 - (2 * (t % 1) - 1) ** 2, 0, 1)) for t in (warp, weft)]
    # A yarn that dives meets the crossing one half-way.
    bends = [
        0.5 + 0.5 * np.cos(np.pi / 2 * (((other - base) % 4) - 1))
        for other, base in ((weft + column, 0.0), (warp + row, 2.0))
    ]
    lifts = [p * (0.35 + 0.65 * b) for p, b in zip(profiles, bends, strict=True)]
    is_warp = np.where(np.abs(lifts[0] - lifts[1]) < 1e-6, over, lifts[0] > lifts[1])
    fibres = 0.04 * np.sin(2 * np.pi * np.where(is_warp, warp * 5 + weft, weft * 5 + warp))
    height = depth * (np.maximum(*lifts) + fibres)
    colours = np.array([[0.12, 0.22, 0.42], [0.62, 0.5, 0.3]])
    yarn = np.where(is_warp, column, row + 977) % 1024
    shade = 1 + 0.12 * rng.standard_normal(1024)[yarn] + 0.1 * _noise(size, 32, rng)
    albedo = colours[1 - is_warp.astype(int)] * shade[..., None]
    tangent = np.where(is_warp, np.pi / 2, 0.0)
    return _relief(
        "woven", height, albedo, 0.06, 0.25, across=np.full((size, size), 0.5), tangent=tangent
    )


def gauze(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """Open plain weave: thin yarns over and under each other, and holes between them."""
    yarns, reach = max(4, size // 16 // 2 * 2), 0.34
    v, u = _grid(size)
    lifts, shade = [], []
    for along, across in ((v, u), (u, v)):
        at = across * yarns
        profile = np.clip(1 - (((at % 1) - 0.5) / reach) ** 2, 0, 1)
        # Up where the other kind of yarn is down.
        side = 1.0 if along is v else -1.0
        bend = 0.5 + 0.5 * side * np.cos(np.pi * (along * yarns - 0.5)) * (
            1 - 2 * (np.floor(at) % 2)
        )
        lifts.append(np.where(profile > 0, 0.15 + 0.45 * bend + 0.4 * np.sqrt(profile), 0))
        shade.append(1 + 0.1 * rng.standard_normal(1024)[np.floor(at).astype(int) % 1024])
    is_warp = lifts[0] >= lifts[1]
    highest = np.maximum(*lifts)
    colours = np.array([[0.55, 0.42, 0.2], [0.3, 0.12, 0.1]])
    albedo = colours[1 - is_warp.astype(int)] * np.where(is_warp, *shade)[..., None]
    tangent = np.where(is_warp, np.pi / 2, 0.0)
    return _relief(
        "gauze", depth * highest, albedo, 0.05, 0.25, across=np.full((size, size), 0.5),
        tangent=tangent, opacity=(highest > 0).astype(np.float32),
    )  # fmt: skip


def knit(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """Stockinette: columns of V-shaped stitches, each drawn through the one below."""
    wales = max(4, size // 24)
    courses = round(wales * 1.25)
    v, u = _grid(size)
    across, down = (u * wales) % 1 - 0.5, (v * courses) % 1
    highest, fibre, tangent = (np.zeros((size, size)) for _ in range(3))
    for side in (-1, 1):
        lean = np.radians(26) * side
        for course in (-1, 0, 1):
            # One leg of a stitch, an ellipsoid: it leans outwards on its way up, and its foot
            # dips behind the stitch below.
            x, y = across - 0.25 * side, (down - 0.5 - course) * wales / courses
            along = x * np.sin(lean) - y * np.cos(lean)
            over = x * np.cos(lean) + y * np.sin(lean)
            leg = np.sqrt(np.clip(1 - (along / 0.68) ** 2 - (over / 0.23) ** 2, 0, None))
            leg = leg * np.clip(0.8 + 0.45 * along, 0, None)
            wins = leg > highest
            highest = np.where(wins, leg, highest)
            fibre = np.where(wins, np.sin(2 * np.pi * (along * 5 + over * side * 6)), fibre)
            tangent = np.where(wins, np.pi / 2 - lean, tangent)
    height = depth * (highest + 0.04 * fibre * (highest > 0))
    shade = 1 + 0.12 * _noise(size, 32, rng) + 0.08 * fibre
    albedo = (
        np.array([0.5, 0.11, 0.13]) * (shade * (0.35 + 0.65 * _smooth(highest, 0, 0.4)))[..., None]
    )
    return _relief(
        "knit", height, albedo, 0.04, 0.5, across=np.full((size, size), 0.8), tangent=tangent
    )


def scratched(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """Brushed coloured metal with scratches of all directions, each an anisotropic gloss."""
    v, u = _grid(size)
    brushed = _noise(size, 64, rng, stretch=16)
    height = 0.15 * depth * brushed
    tangent = np.zeros((size, size))
    groove = np.zeros((size, size))
    for _ in range(40):
        angle, offset = rng.uniform(0, np.pi), rng.uniform(0, 1, 2)
        # Integer slopes close on the tile.
        steps = np.rint(2 * np.array([np.cos(angle), np.sin(angle)])).astype(int)
        if not steps.any():
            continue
        distance = (steps[1] * (u - offset[0]) - steps[0] * (v - offset[1]) + 0.5) % 1 - 0.5
        distance /= np.hypot(*steps)
        along = (steps[0] * u + steps[1] * v) / np.hypot(*steps)
        mask = np.exp(-((distance * size / 0.9) ** 2)) * (
            np.sin(2 * np.pi * (along + rng.uniform())) > rng.uniform(-0.5, 0.9)
        )
        tangent = np.where(mask > np.maximum(groove, 0.3), np.arctan2(-steps[1], steps[0]), tangent)
        groove = np.maximum(groove, mask)
    height = height - depth * groove
    gold = np.array([0.95, 0.72, 0.38])
    specular = np.clip(gold * (1 + 0.05 * _noise(size, 20, rng)[..., None]), 0, 1)
    return _relief(
        "scratched", height, np.full((size, size, 3), 0.02), specular, 0.12 + 0.05 * groove,
        across=np.full((size, size), 0.35), tangent=tangent,
    )  # fmt: skip


def perforated(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """A painted sheet with round holes to see through."""
    count = 6
    v, u = _grid(size)
    row = np.floor(v * count)
    x = (u * count + 0.5 * (row % 2)) % 1 - 0.5
    y = (v * count) % 1 - 0.5
    distance = np.hypot(x, y)
    sheet = _smooth(distance, 0.28, 0.33)
    height = depth * (sheet - 1 + 0.05 * _noise(size, 24, rng) * sheet)
    albedo = np.array([0.2, 0.45, 0.35]) * (1 + 0.08 * _noise(size, 40, rng)[..., None])
    return _relief(
        "perforated", height, albedo, 0.05, 0.3, opacity=(distance > 0.28).astype(np.float32)
    )


def print_(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """A flat print: patterns of matt and glossy ink, no relief to speak of."""
    v, u = _grid(size)
    waves = np.sin(2 * np.pi * (3 * u + np.sin(2 * np.pi * v)))
    dots = np.cos(2 * np.pi * 8 * u) * np.cos(2 * np.pi * 8 * v)
    ink = _smooth(waves, -0.1, 0.1)
    spot = _smooth(dots, 0.3, 0.45)
    paper = np.array([0.82, 0.8, 0.74])
    albedo = _mix(
        _mix(paper, np.array([0.1, 0.25, 0.5]), ink[..., None]),
        np.array([0.75, 0.2, 0.12]),
        (spot * (1 - ink))[..., None],
    )
    albedo = albedo * (1 + 0.05 * _noise(size, 48, rng)[..., None])
    return _relief("print", depth * 0.1 * _noise(size, 32, rng), albedo, 0.05, _mix(0.7, 0.15, ink))


def brick(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """The photograph of a brick wall, with relief read from its brightness: mortar is low."""
    return _photograph("brick", size, -depth, rng, np.array([0.62, 0.32, 0.24]), 0.6)


def grass(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """The photograph of grass, with relief read from its brightness."""
    return _photograph("grass", size, depth, rng, np.array([0.3, 0.5, 0.16]), 0.5)


def gravel(size: int, depth: float, rng: np.random.Generator) -> Relief:
    """The photograph of gravel, with relief read from its brightness."""
    return _photograph("gravel", size, depth, rng, np.array([0.52, 0.48, 0.42]), 0.45)


# Name -> function and its relief in texels.
CATALOGUE: dict[str, tuple[Maker, float]] = {
    "cobbles": (cobbles, 8.0),
    "woven": (woven, 1.5),
    "gauze": (gauze, 3.0),
    "knit": (knit, 3.0),
    "scratched": (scratched, 0.4),
    "perforated": (perforated, 3.0),
    "print": (print_, 0.3),
    "brick": (brick, 1.5),
    "grass": (grass, 1.5),
    "gravel": (gravel, 1.5),
}


def _photograph(
    name: str, size: int, depth: float, rng: np.random.Generator, tint: Floats, rough: float
) -> Relief:
    """A grey photograph made periodic, coloured, and given relief: bright is high, if depth > 0."""
    from scipy.ndimage import gaussian_filter
    from skimage import data
    from skimage.transform import resize

    photograph = getattr(data, name)() / 255.0
    tile = _periodic(photograph)
    grey = resize(tile, (size, size), order=1, mode="wrap", anti_aliasing=size < tile.shape[0])
    linear = grey**2.2
    scales = [gaussian_filter(grey, sigma * size / 128, mode="wrap") for sigma in (0.8, 2.0, 5.0)]
    bumps = sum(s - s.mean() for s in scales)
    low, high = np.percentile(bumps, [1, 99])
    height = depth * np.clip((bumps - low) / (high - low), 0, 1)
    albedo = tint * (linear / linear.mean())[..., None] ** 0.7
    albedo = albedo * (1 + 0.04 * _noise(size, 8, rng)[..., None])
    return _relief(name, height, albedo, 0.04, np.clip(rough + 0.3 * (0.5 - grey), 0.1, 1))


def _periodic(image: Floats) -> Floats:
    """The periodic part of an image, without the cross that its borders would make.

    Source: Moisan, "Periodic plus smooth image decomposition", 2011.
    """
    h, w = image.shape
    border = np.zeros_like(image)
    border[0] += image[0] - image[-1]
    border[-1] -= image[0] - image[-1]
    border[:, 0] += image[:, 0] - image[:, -1]
    border[:, -1] -= image[:, 0] - image[:, -1]
    q = np.cos(2 * np.pi * np.arange(h) / h)[:, None] + np.cos(2 * np.pi * np.arange(w) / w)
    denominator = 2 * q - 4
    denominator[0, 0] = 1
    spectrum = np.fft.fft2(border) / denominator
    spectrum[0, 0] = 0
    return np.clip(image - np.fft.ifft2(spectrum).real, 0, 1)


def _voronoi(size: int, seeds: Floats) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Distances to the two nearest seeds on the torus, and which is nearest; (size, size) each."""
    v, u = _grid(size)
    points = np.stack([v, u], -1)[:, :, None]
    steps = np.abs(points - seeds)
    distance = np.linalg.norm(np.minimum(steps, 1 - steps), axis=-1)
    two = np.argpartition(distance, 1, axis=-1)[..., :2]
    pair = np.take_along_axis(distance, two, -1)
    swap = pair[..., 0] > pair[..., 1]
    nearest = np.where(swap, two[..., 1], two[..., 0])
    return pair.min(-1), pair.max(-1), nearest


def _noise(size: int, cells: int, rng: np.random.Generator, *, stretch: int = 1) -> Floats:
    """(size, size) periodic band-limited noise, about -1..1; longer along u by `stretch`."""
    spectrum = np.fft.fft2(rng.standard_normal((size, size)))
    f = np.fft.fftfreq(size) * size
    radius = np.hypot(f[:, None], f[None] * stretch)
    noise = np.fft.ifft2(spectrum * np.exp(-((radius / (cells / 2)) ** 2))).real
    return np.clip(noise / (2 * noise.std() + 1e-12), -1.5, 1.5)


def _grid(size: int) -> tuple[Floats, Floats]:
    """v and u of texel centres, (size, size) each."""
    at = (np.arange(size) + 0.5) / size
    v, u = np.meshgrid(at, at, indexing="ij")
    return v, u


def _smooth(x: Floats, low: float, high: float) -> Floats:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _mix(a: Floats | float, b: Floats | float, share: Floats) -> Floats:
    return a + (np.asarray(b) - a) * share


def _relief(
    name: str,
    height: Floats,
    albedo: Floats,
    specular: Floats | float,
    roughness: Floats | float,
    *,
    across: Floats | None = None,
    tangent: Floats | None = None,
    opacity: Floats | None = None,
) -> Relief:
    """Clipped to what surfaces can be, with the plane at the mean height."""
    h, w = height.shape
    return Relief(
        height=(height - height.mean()).astype(np.float32),
        albedo=np.clip(np.broadcast_to(albedo, (h, w, 3)), 0, 0.95).astype(np.float32),
        specular=np.clip(np.broadcast_to(specular, (h, w, 3)), 0, 1).astype(np.float32),
        roughness=np.clip(np.broadcast_to(roughness, (h, w)), 0.05, 1).astype(np.float32),
        roughness_across=None if across is None else across.astype(np.float32),
        tangent=None if tangent is None else tangent.astype(np.float32),
        opacity=None if opacity is None else opacity.astype(np.float32),
        name=name,
        provenance={"source": f"btfkit procedural: {name}", "synthetic": True},
    )
