"""Meshes that tell a material how they bend. All that builds meshes of Mitsuba stands here."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from btfkit.render.mitsuba.asked import CURVATURE
from btfkit.shapes.bending import vertex_curvature


def add_curvature(mesh: Any) -> None:
    """Give a mesh the attribute that a material with silhouettes reads.

    Args:
        mesh: of Mitsuba, with vertex normals and texture coordinates.

    Raises:
        ValueError: it has none.
    """
    told = mi.traverse(mesh)
    parts = [
        np.array(told[name]).reshape(-1, k)
        for name, k in (
            ("vertex_positions", 3), ("vertex_normals", 3), ("vertex_texcoords", 2), ("faces", 3),
        )
    ]  # fmt: skip
    for name, part in zip(("normals", "texture coordinates"), parts[1:3], strict=True):
        if not len(part):
            raise ValueError(f"mesh {mesh.id()} has no vertex {name}, which curvature is told by")
    bend = vertex_curvature(parts[0], parts[1], parts[2], parts[3].astype(np.int64))
    mesh.add_attribute(CURVATURE, 3, np.ascontiguousarray(bend).reshape(-1))


def heightfield(position: Any, uv: Any, faces: Any, bsdf: Any) -> Any:
    """A mesh of positions (v, 3), uv (v, 2) and triangles (f, 3); normals are those of faces."""
    props = mi.Properties()
    props["mesh_bsdf"] = bsdf
    mesh = mi.Mesh("relief", len(position), len(faces), has_vertex_texcoords=True, props=props)
    told = mi.traverse(mesh)
    told["vertex_positions"] = np.ascontiguousarray(position, np.float32).reshape(-1)
    told["vertex_texcoords"] = np.ascontiguousarray(uv, np.float32).reshape(-1)
    told["faces"] = np.ascontiguousarray(faces, np.uint32).reshape(-1)
    told.update()
    return mesh
