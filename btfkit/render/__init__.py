"""Pictures of a material on simple shapes."""

from btfkit.shapes import obj

__all__ = ["obj"]
