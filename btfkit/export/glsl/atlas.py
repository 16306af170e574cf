"""All textures of a program in one array texture of four numbers a texel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from numpy.typing import NDArray

from btfkit.export.arrays import textures
from btfkit.program import Heights, Program

Texels = Literal["half", "byte"]
Array = NDArray[Any]
# What every implementation of WebGL2 has at least: 2048 by the standard. None in use has less
# than four times that, which is what is asked for here.
_MOST_SIDE, _MOST_LAYERS = 8192, 256


@final
@dataclass(frozen=True)
class Place:
    """Where a level of a texture lies: its corner, its first layer, its size.

    Attributes:
        x, y, layer: of the first group of four channels; group g lies in layer + g.
        w, h: texels.
    """

    x: int
    y: int
    layer: int
    w: int
    h: int


@final
@dataclass(frozen=True, eq=False)
class Atlas:
    """Textures as they are uploaded.

    Attributes:
        size: (layers, h, w) of the array texture.
        places: of each level, by the name of the texture.
        low, step: (4 g,) of each texture by name: a texel is low + step x what is stored.
        data: the texels of all levels, one after the other: groups, rows, columns, four.
        order: (place, groups) of each stretch of `data`.
        heights: (h, w) float16, or None.
    """

    size: tuple[int, int, int]
    places: dict[str, list[Place]]
    low: dict[str, Array]
    step: dict[str, Array]
    data: Array
    order: list[tuple[Place, int]]
    heights: Array | None

    def described(self) -> dict[str, Any]:
        """What whoever uploads it must know; `heights` too, whose texels are made four corners."""
        rects = [[p.x, p.y, p.layer, p.w, p.h, groups] for p, groups in self.order]
        heights = None if self.heights is None else list(self.heights.shape[::-1])
        kind = "half" if self.data.dtype == np.float16 else "byte"
        return {"kind": kind, "size": list(self.size), "rects": rects, "heights": heights}


def atlas(program: Program, texels: Texels) -> Atlas:
    """The textures of a program, as half floats or as bytes between the ends of each channel.

    Heights are half floats in either case: a ray that misses what it met ends far away.

    Raises:
        ValueError: textures too large for an array texture, or numbers for a half float.
    """
    stacks = {t.name: [_grouped(level) for level in t.levels] for t in textures(program)}
    places, size = _packed({name: [s.shape[:3] for s in stack] for name, stack in stacks.items()})
    if max(size[1:]) > _MOST_SIDE or size[0] > _MOST_LAYERS:
        raise ValueError(
            f"textures of {size[2]} x {size[1]} texels in {size[0]} layers; a shader takes "
            f"{_MOST_SIDE} x {_MOST_SIDE} in {_MOST_LAYERS}: fit a smaller texture"
        )
    low, step, parts = {}, {}, []
    for name, stack in stacks.items():
        stored, low[name], step[name] = _stored(name, stack, texels)
        parts += [array.reshape(-1) for array in stored]
    order = [(place, stack[0].shape[0]) for name, stack in stacks.items() for place in places[name]]
    heights = None
    if isinstance(program.depth, Heights):
        (heights,), _, _ = _stored("heights", [np.asarray(program.depth.heights)], "half")
    return Atlas(size, places, low, step, np.concatenate(parts), order, heights)


def quantised(program: Program, texels: Texels) -> Program:
    """The program with the textures that its atlas holds: what a shader of it computes."""
    from dataclasses import replace

    made = atlas(program, texels)
    found: dict[str, list[Array]] = {}
    at = 0
    for name, places in made.places.items():
        groups = len(made.low[name]) // 4
        found[name] = []
        for place in places:
            count = groups * place.h * place.w * 4
            stored = made.data[at : at + count].reshape(groups, place.h, place.w, 4)
            level = np.moveaxis(stored, 0, 2).reshape(place.h, place.w, groups * 4)
            found[name].append(made.low[name] + made.step[name] * level.astype(np.float32))
            at += count

    def exchanged(texture: Any) -> Any:
        k = texture.levels[0].shape[-1]
        return replace(texture, levels=tuple(level[..., :k] for level in found[texture.name]))

    depth: Any = program.depth
    if isinstance(depth, Heights) and made.heights is not None:
        depth = replace(depth, heights=made.heights.astype(np.float32))
        if depth.opacity is not None:
            depth = replace(depth, opacity=found["opacity"][0][..., 0])
    elif depth is not None:
        depth = replace(depth, texture=exchanged(depth.texture))
    cover = program.cover and replace(program.cover, texture=exchanged(program.cover.texture))
    return replace(
        program,
        cover=cover,
        textures=tuple(exchanged(texture) for texture in program.textures),
        scaling=program.scaling and exchanged(program.scaling),
        depth=depth,
    )


def _grouped(level: Array) -> Array:
    """(g, h, w, 4) of a texture (h, w, k): four channels a group, zeros after the last."""
    h, w, k = level.shape
    groups = -(-k // 4)
    padded = np.zeros((h, w, groups * 4), np.float32)
    padded[..., :k] = level
    return np.moveaxis(padded.reshape(h, w, groups, 4), 2, 0)


def _stored(name: str, stack: list[Array], texels: Texels) -> tuple[list[Array], Array, Array]:
    most = float(np.finfo(np.float16).max)
    if texels == "half":
        if max(float(np.abs(array).max()) for array in stack) > most:
            raise ValueError(f"texture {name} holds numbers above {most:.0f}: no half float does")
        groups = stack[0].shape[0] if stack[0].ndim == 4 else 1
        halves = [array.astype(np.float16) for array in stack]
        return halves, np.zeros(4 * groups, np.float32), np.ones(4 * groups, np.float32)
    low = np.min([array.min(axis=(1, 2)) for array in stack], axis=0)
    high = np.max([array.max(axis=(1, 2)) for array in stack], axis=0)
    step = ((high - low) / 255).astype(np.float32)
    # A constant channel has no range: any step but 0 keeps it exact.
    divisor = np.where(step > 0, step, 1)[:, None, None]
    codes = [np.rint((a - low[:, None, None]) / divisor).astype(np.uint8) for a in stack]
    return codes, low.reshape(-1).astype(np.float32), step.reshape(-1)


def _packed(
    sizes: dict[str, list[tuple[int, int, int]]],
) -> tuple[dict[str, list[Place]], tuple[int, int, int]]:
    """A place for every (groups, h, w): shelf by shelf, in planes of as many layers as groups."""
    every = [size for levels in sizes.values() for size in levels]
    most_h, most_w = max(h for _, h, _ in every), max(w for _, _, w in every)
    places: dict[str, list[Place]] = {name: [] for name in sizes}
    layer = 0
    for groups in sorted({g for g, _, _ in every}):
        mine = [(name, k, size) for name, levels in sizes.items()
                for k, size in enumerate(levels) if size[0] == groups]  # fmt: skip
        x = y = shelf = 0
        for name, _, (_, h, w) in sorted(mine, key=lambda item: (-item[2][1], item[1])):
            if x + w > most_w:
                x, y, shelf = 0, y + shelf, 0
            if y + h > most_h:
                x, y, shelf, layer = 0, 0, 0, layer + groups
            places[name].append(Place(x, y, layer, w, h))
            x, shelf = x + w, max(shelf, h)
        layer += groups
    return places, (layer, most_h, most_w)
