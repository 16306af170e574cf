"""BTFs that are one image a pair, in a folder or a zip: what UBO2003, UTIA and others share."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, final

import numpy as np

from btfkit.btf import BTF, RGB
from btfkit.errors import FormatError
from btfkit.io import anglenames, images
from btfkit.io.archive import Archive
from btfkit.textures import Array, Textures

Decode = Callable[[str, bytes], Array]


@final
class ImageTextures(Textures):
    """Textures that are members of an archive, each decoded when it is asked for.

    Args:
        archive: where the members lie.
        names: (n,) members.
        decode: name and bytes to (h, w, c) float32.
        scale: (n, ...) factors that broadcast against (h, w, c), or None.

    Raises:
        FormatError: the first member cannot be decoded; its size is everybody's.
    """

    def __init__(
        self, archive: Archive, names: list[str], decode: Decode, scale: Array | None = None
    ) -> None:
        self._archive, self._names, self._decode, self._scale = archive, names, decode, scale
        first = decode(names[0], archive.read(names[0]))
        self.shape = (len(names), *first.shape)

    def _read(self, index: int) -> Array:
        name = self._names[index]
        image = self._decode(name, self._archive.read(name))
        if image.shape != self.shape[1:]:
            raise FormatError(
                self._archive.path / name,
                f"is {' x '.join(map(str, image.shape))}; the first image is "
                f"{' x '.join(map(str, self.shape[1:]))}",
            )
        return image if self._scale is None else image * self._scale[index]


def read_named(
    path: Path,
    decode: Decode,
    *,
    suffixes: set[str],
    cosine: str = "in",
    channels: tuple[str, ...] | None = None,
    provenance: Mapping[str, Any],
) -> BTF:
    """A BTF of images named by their angles.

    Args:
        path: folder or zip.
        decode: name and bytes to linear values.
        suffixes: of the images; other members are left alone.
        cosine: "in" where the data hold the cosine of the light, "out" where it is divided out.
        channels: names; None takes RGB or Y by the count.
        provenance: format, options and assumptions.

    Raises:
        FormatError: no image with all four angles, or one pair twice.
    """
    archive = Archive(path)
    names = [n for n in archive.names if PurePosixPath(n).suffix.lower() in suffixes]
    pairs = anglenames.ordered(str(path), names)
    if not pairs:
        raise FormatError(path, f"none of {len(names)} images is named by its four angles")
    unnamed = len(names) - len(pairs)
    missing = anglenames.missing_pairs([angles for _, angles in pairs])
    if missing or unnamed:
        warnings.warn(
            f"{path}: {missing} pairs of the product of its lights and views are missing, "
            f"{unnamed} images are not named by angles",
            stacklevel=3,
        )
    light, view = anglenames.light_and_view([angles for _, angles in pairs])
    textures = ImageTextures(
        archive, [name for name, _ in pairs], decode, cosine_factor(cosine, light)
    )
    c = textures.shape[3]
    return BTF(
        textures=textures,
        light=light,
        view=view,
        channels=channels or (RGB if c == 3 else ("Y",)),
        provenance={"source": str(path), "missing_pairs": missing, **provenance},
    )


def cosine_factor(cosine: str, light: np.ndarray[Any, Any]) -> Array | None:
    """(n, 1, 1, 1) factors that put the cosine of the light in; None where it is in."""
    if cosine == "in":
        return None
    if cosine != "out":
        raise ValueError(f"cosine {cosine!r}; expected in or out")
    return np.maximum(light[:, 2], 0).astype(np.float32)[:, None, None, None]


def assumptions(**options: tuple[Any, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What was given and what was assumed.

    Args:
        **options: name = (given or None, default).

    Returns:
        values by name, and a provenance entry with `options` and `assumed`.
    """
    values = {n: default if given is None else given for n, (given, default) in options.items()}
    given = {n: v for n, (v, _) in options.items() if v is not None}
    assumed = {n: d for n, (v, d) in options.items() if v is None}
    return values, {"options": given, "assumed": assumed}


def looks_named(names: list[str], separator: str, suffixes: set[str]) -> bool:
    """Whether the first images of a listing are named by angles with this separator between."""
    candidates = [n for n in names if PurePosixPath(n).suffix.lower() in suffixes]
    for name in candidates[:20]:
        base = PurePosixPath(name).name
        if anglenames.parse(base) and separator in base.split(".")[0].lstrip("0123456789 "):
            return True
    return False


def decode_image(transfer: str, orientation: str = "standard") -> Decode:
    """A decoder with its options bound."""

    def decode(name: str, data: bytes) -> Array:
        if data[:2] == b"#?":
            return images.read_hdr(name, data, orientation=orientation)
        return images.read(name, data, transfer=transfer)

    return decode
