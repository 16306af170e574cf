"""The shapes by their names."""

from __future__ import annotations

from pathlib import Path

from btfkit.errors import unknown
from btfkit.shapes.closed import Cylinder, Plane, Shape, Sphere
from btfkit.shapes.torus import Torus

SHAPES = ("plane", "sphere", "cylinder", "torus", "FILE.obj|ply")


def shape_of(name: str, *, repeat: int = 1, aspect: float = 1.0, picture: float = 1.0) -> Shape:
    """A shape by its name, or a mesh by its file.

    Args:
        name: one of `SHAPES`.
        repeat: tiles across its front; of a mesh, across the unit of its texture coordinates.
        aspect: tile width / tile height.
        picture: width / height of the picture, which a plane fills.

    Raises:
        ValueError: no such shape.
        FormatError: a mesh that cannot be read, or that has no texture coordinates.
    """
    if name.lower().endswith((".obj", ".ply")):
        from btfkit.shapes import obj, ply
        from btfkit.shapes.mesh import Mesh

        read = obj.read if name.lower().endswith(".obj") else ply.read
        return Mesh(read(Path(name)), repeat=repeat, aspect=aspect)
    if name == "plane":
        return Plane(repeat=repeat, aspect=aspect, picture=picture)
    round_shapes: dict[str, type[Sphere | Cylinder | Torus]] = {
        "sphere": Sphere,
        "cylinder": Cylinder,
        "torus": Torus,
    }
    if name not in round_shapes:
        raise ValueError(unknown("shape", name, SHAPES))
    return round_shapes[name](repeat=repeat, aspect=aspect)
