"""BTFs that are one image a pair, in a folder or a zip: what UBO2003, UTIA and others share."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, final

import numpy as np

from btfkit import directions
from btfkit.btf import BTF, RGB
from btfkit.errors import FormatError
from btfkit.io import anglenames, images
from btfkit.io.anglenames import Angles
from btfkit.io.archive import Archive
from btfkit.io.images import Image
from btfkit.textures import Array, Textures

Decode = Callable[[str, bytes], Image]
# Pair, h and w to factors that broadcast against (h, w, c).
Scale = Callable[[int, int, int], Array]


@final
class ImageTextures(Textures):
    """Textures that are members of an archive, each decoded when it is asked for.

    Args:
        archive: where the members lie.
        names: (n,) members.
        decode: name and bytes to a picture.
        scale: what the values of a pair are multiplied by, or None.

    Attributes:
        found: what the first image says of itself, for the record.

    Raises:
        FormatError: the first member cannot be decoded; its size is everybody's.
    """

    def __init__(
        self, archive: Archive, names: list[str], decode: Decode, scale: Scale | None = None
    ) -> None:
        self._archive, self._names, self._decode, self._scale = archive, names, decode, scale
        first = decode(names[0], archive.read(names[0]))
        self.shape = (len(names), *first.linear.shape)
        self.found = first.said

    def scaled(self, scale: Scale) -> ImageTextures:
        """The same members with other factors; nothing is decoded."""
        other = copy.copy(self)
        other._scale = scale
        return other

    def _read(self, index: int) -> Array:
        name = self._names[index]
        image = self._decode(name, self._archive.read(name)).linear
        if image.shape != self.shape[1:]:
            raise FormatError(
                self._archive.path / name,
                f"is {' x '.join(map(str, image.shape))}; the first image is "
                f"{' x '.join(map(str, self.shape[1:]))}",
            )
        if self._scale is None:
            return image
        return image * self._scale(index, *image.shape[:2])


def read_named(
    path: Path,
    decode: Decode,
    *,
    suffixes: set[str],
    cosine: str = "in",
    channels: Callable[[], tuple[str, ...]] | None = None,
    relit: Callable[[Array, Array], Array] | None = None,
    number: Callable[[Angles], int] | None = None,
    provenance: Mapping[str, Any],
    **more: Any,
) -> BTF:
    """A BTF of images named by their angles.

    Args:
        path: folder or zip.
        decode: name and bytes to a picture.
        suffixes: of the images; other members are left alone.
        cosine: "in" where the data hold the cosine of the light, "out" where it is divided out.
        channels: names, asked for once the first image is decoded; None takes RGB or Y by the
            count.
        relit: (n, 3) lights and views of the names to (n, 3) lights as they really stood.
        number: the running number that a name with these angles ought to have; -1 for any.
        provenance: format, options and assumptions.
        **more: further fields of the BTF.

    Raises:
        FormatError: no image with all four angles, or one pair twice.
    """
    archive = Archive(path)
    names = [n for n in archive.names if PurePosixPath(n).suffix.lower() in suffixes]
    pairs = anglenames.ordered(str(path), names)
    if not pairs:
        raise FormatError(path, f"none of {len(names)} images is named by its four angles")
    angles = [each for _, each in pairs]
    record = {
        "missing_pairs": anglenames.missing_pairs(angles),
        "unnamed_images": len(names) - len(pairs),
        "misnumbered_images": sum(
            a.number >= 0 and number(a) not in (-1, a.number) for a in angles if number
        ),
    }
    if any(record.values()):
        warnings.warn(
            f"{path}: {record['missing_pairs']} pairs of the product of its lights and views are "
            f"missing, {record['unnamed_images']} images are not named by angles, "
            f"{record['misnumbered_images']} have a running number that their angles contradict "
            "(the angles count)",
            stacklevel=3,
        )
    light, view = anglenames.light_and_view(angles)
    if relit is not None:
        light = relit(light, view)
    textures = ImageTextures(
        archive, [name for name, _ in pairs], decode, cosine_factor(cosine, light)
    )
    return assembled(
        path,
        textures,
        light=light,
        view=view,
        channels=channels and channels(),
        provenance={"source": str(path), **record, **provenance},
        **more,
    )


def assembled(
    path: Path, textures: Textures, *, provenance: Mapping[str, Any], **fields: Any
) -> BTF:
    """A BTF of what a file says; what no BTF can be is the file's fault.

    Args:
        path: for messages.
        textures: (n, h, w, c).
        provenance: of the BTF.
        **fields: other fields of the BTF; channels None takes RGB or Y by the count.

    Raises:
        FormatError: the parts do not fit, a direction is none, or a pair is there twice.
    """
    found = textures.found if isinstance(textures, ImageTextures) else {}
    if found:
        provenance = _told(path, provenance, found)
    if fields.get("channels") is None:
        c = textures.shape[3]
        if c not in (1, 3):
            raise FormatError(path, f"images of {c} channels; expected 1 or 3")
        fields["channels"] = RGB if c == 3 else ("Y",)
    try:
        btf = BTF(textures=textures, provenance=dict(provenance), **fields)
    except ValueError as error:
        raise FormatError(path, str(error)) from error
    if btf.validity is not None and not btf.validity.any():
        raise FormatError(path, "its mask leaves nothing valid", remedy="draw what counts in it")
    poses = [btf.light, btf.view, btf.light_position, btf.view_position]
    rows = np.concatenate([pose for pose in poses if pose is not None], axis=1)
    _, first, index = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    if len(first) < len(btf):
        again = next(i for i, row in enumerate(index.reshape(-1)) if first[row] != i)
        raise FormatError(
            path,
            f"images {first[index.reshape(-1)[again]]} and {again} (from 0) have the same light "
            "and view",
            remedy="remove one",
        )
    return btf


def _told(path: Path, provenance: Mapping[str, Any], found: Mapping[str, Any]) -> Mapping[str, Any]:
    """The record with what the first image declares; what no longer has to be assumed goes."""
    record = {**provenance, "found": dict(found)}
    assumed = dict(provenance.get("assumed", {}))
    if found.get("curve") and assumed.pop("transfer", None) is not None:
        record["assumed"] = assumed
    if "colour" in found and "converted" in found:
        warnings.warn(
            f"{path}: the images declare {found['colour']}; they are converted to linear BT.709",
            stacklevel=4,
        )
    if "doubt" in found:
        warnings.warn(f"{path}: in the first image {found['doubt']}", stacklevel=4)
    return record


def cosine_factor(cosine: str, light: np.ndarray[Any, Any]) -> Scale | None:
    """What puts the cosine of far lights (n, 3) into values; None where it is in them."""
    if cosine == "in":
        return None
    if cosine != "out":
        raise ValueError(f"cosine {cosine!r}; expected in or out")
    return Gains(np.maximum(directions.normalize(light)[:, 2:], 0).astype(np.float32))


@final
class Product:
    """Several scales one after the other; None counts as 1.

    Args:
        scales: each (pair, h, w) to factors.
        power: of their product.
    """

    def __init__(self, *scales: Scale | None, power: int = 1) -> None:
        self._scales, self._power = [each for each in scales if each is not None], power

    def __call__(self, index: int, h: int, w: int) -> Array:
        factor = np.ones((1, 1, 1), np.float32)
        for scale in self._scales:
            factor = factor * scale(index, h, w)
        return factor**self._power


@final
class Gains:
    """Factors (n, 1 or c) of the pairs."""

    def __init__(self, gains: Array) -> None:
        self._gains = gains

    def __call__(self, index: int, h: int, w: int) -> Array:
        return self._gains[index]


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


@final
class Lost:
    """Counts what 8-bit images cannot hold."""

    def __init__(self) -> None:
        self.outside = self.unmeasured = 0

    def count(self, texture: Array) -> Array:
        """`texture`, counted."""
        self.outside += int(np.count_nonzero((texture < 0) | (texture > 1)))
        self.unmeasured += int(np.count_nonzero(np.isnan(texture)))
        return texture

    def warn(self, path: str | os.PathLike[str], *, remedy: str) -> None:
        """Say what was lost, if anything was."""
        if self.outside or self.unmeasured:
            warnings.warn(
                f"{os.fspath(path)}: {self.outside} values outside 0..1 were clamped and "
                f"{self.unmeasured} that were not measured written as 0; {remedy}",
                stacklevel=3,
            )


def looks_named(names: list[str], suffixes: set[str], *, spaces: bool) -> bool:
    """Whether one of the first images is named by angles, with or without spaces between."""
    candidates = [n for n in names if PurePosixPath(n).suffix.lower() in suffixes]
    for name in candidates[:20]:
        if anglenames.is_named(name):
            return (" " in PurePosixPath(name).stem.strip()) == spaces
    return False


@final
class Decoder:
    """Images of one source to linear colour.

    Args:
        transfer: what integer codes mean.
        assumed: whether nobody said so: then the curve that a file declares comes first.
        orientation: of Radiance pictures.
    """

    def __init__(self, transfer: str, *, assumed: bool, orientation: str = "standard") -> None:
        self._transfer, self._assumed, self._orientation = transfer, assumed, orientation

    @classmethod
    def of(cls, values: Mapping[str, Any], record: Mapping[str, Any]) -> Decoder:
        """As `assumptions` settled it."""
        return cls(values["transfer"], assumed="transfer" in record["assumed"])

    def __call__(self, name: str, data: bytes) -> Image:
        return images.decode(
            name,
            data,
            transfer=self._transfer,
            assumed=self._assumed,
            orientation=self._orientation,
        )
